//! Server's side of pairing. At most one window is open, for two minutes, three tries and one success.

use std::time::{Duration, Instant};

use hmac::{Hmac, Mac};
use sha2::Sha256;
use vizflyt_protocol::messages::{Grant, PairingProof, PairingRequest, PairingShare};

use super::{Binding, Code, PairingRole, Transcript, is, start};
use crate::paired::is_name;
use crate::{Client, Fingerprint, Role};

/// Time for which a code is valid.
pub const VALID: Duration = Duration::from_mins(2);
/// Maximum number of wrong codes per window.
pub const TRIES: u32 = 3;

/// Pairing state of the server.
#[derive(Debug, Default)]
pub struct PairingServer {
    window: Option<Window>,
    /// Number of windows opened since the start.
    opened: u64,
}

#[derive(Debug)]
struct Window {
    number: u64,
    code: Code,
    grant: Grant,
    until: Instant,
    tries_left: u32,
}

/// Open window, for display to the user who opened it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WindowState {
    /// Code to type.
    pub code: Code,
    /// Rights that the pairing grants.
    pub grant: Grant,
    /// Remaining time.
    pub left: Duration,
    /// Remaining number of tries.
    pub tries_left: u32,
}

/// Reason why a computer is not paired, as a sentence for its user.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// No window is open.
    #[error(
        "no pairing is open; press 'pair a computer' on the server's page, or start the server with --pair, then try again"
    )]
    Closed,
    /// The proof is wrong.
    #[error("wrong code, {left} of {TRIES} tries left")]
    Wrong {
        /// Remaining tries.
        left: u32,
    },
    /// The proof is wrong, and no tries remain.
    #[error("wrong code, no tries left; open a new pairing for a new code")]
    Shut,
    /// The name cannot be displayed.
    #[error("the computer's name must be 1 to 32 bytes of text; pass --name NAME")]
    Name,
    /// Unexpected or invalid message.
    #[error("the other side uses another pairing protocol; update the older of the two")]
    Foreign,
}

/// Client that has started and must now send its proof.
pub struct Attempt {
    window: u64,
    name: String,
    fingerprint: Fingerprint,
    client: Hmac<Sha256>,
    server: Hmac<Sha256>,
}

/// Client that has proved the code.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Admitted {
    /// The entry for `paired.toml`.
    pub client: Client,
    /// The reply for the client.
    pub grant: Grant,
    /// The server's proof.
    pub proof: PairingProof,
}

impl PairingServer {
    /// Opens a window; returns false if one is already open.
    pub fn open(&mut self, now: Instant, code: Code, grant: Grant) -> bool {
        if self.at(now).is_some() {
            return false;
        }
        self.opened += 1;
        let until = now + VALID;
        let number = self.opened;
        self.window = Some(Window { number, code, grant, until, tries_left: TRIES });
        true
    }

    /// Closes the window.
    pub fn shut(&mut self) {
        self.window = None;
    }

    /// Returns the open window, if there is one.
    pub fn state(&mut self, now: Instant) -> Option<WindowState> {
        self.at(now).map(|window| WindowState {
            code: window.code,
            grant: window.grant.clone(),
            left: window.until.saturating_duration_since(now),
            tries_left: window.tries_left,
        })
    }

    /// Processes a client's first message. Returns the attempt and the server's share.
    ///
    /// An attempt that ends here reveals nothing about the code to the client.
    pub fn begin(
        &mut self,
        now: Instant,
        message: &PairingRequest,
        binding: &Binding,
    ) -> Result<(Attempt, PairingShare), Refusal> {
        let PairingRequest::Begin { name, share } = message else { return Err(Refusal::Foreign) };
        if !is_name(name) {
            return Err(Refusal::Name);
        }
        let window = self.at(now).ok_or(Refusal::Closed)?;
        let (agreement, server_share) = start(PairingRole::B, window.code);
        let transcript =
            Transcript { binding, name, client_share: share, server_share: &server_share };
        let proofs = transcript.prove(PairingRole::B, agreement).ok_or(Refusal::Foreign)?;
        let attempt = Attempt {
            window: window.number,
            name: name.as_str().to_owned(),
            fingerprint: binding.client,
            client: proofs.client,
            server: proofs.server,
        };
        Ok((attempt, server_share))
    }

    /// Processes a client's proof. A correct proof closes the window; a wrong one uses one try.
    pub fn confirm(
        &mut self,
        now: Instant,
        attempt: Attempt,
        message: &PairingRequest,
    ) -> Result<Admitted, Refusal> {
        let PairingRequest::Confirm { proof } = message else { return Err(Refusal::Foreign) };
        // The window may have been closed and another one opened.
        let window =
            self.at(now).filter(|window| window.number == attempt.window).ok_or(Refusal::Closed)?;
        if !is(attempt.client, proof) {
            window.tries_left -= 1;
            let left = window.tries_left;
            if left == 0 {
                self.window = None;
                return Err(Refusal::Shut);
            }
            return Err(Refusal::Wrong { left });
        }
        let grant = window.grant.clone();
        self.window = None;
        let (role, vehicles) = match &grant {
            Grant::Team { vehicles } => {
                (Role::Team, vehicles.iter().map(ToString::to_string).collect())
            }
            Grant::Instructor => (Role::Instructor, Vec::new()),
        };
        let client =
            Client { name: attempt.name, fingerprint: attempt.fingerprint, role, vehicles };
        Ok(Admitted { client, grant, proof: attempt.server.finalize().into_bytes().into() })
    }

    /// Returns the window if it is open at `now`.
    fn at(&mut self, now: Instant) -> Option<&mut Window> {
        if self.window.as_ref().is_some_and(|window| now >= window.until) {
            self.window = None;
        }
        self.window.as_mut()
    }
}
