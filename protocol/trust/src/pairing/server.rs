//! The server's side: one window at a time, two minutes, three tries, one success.

use std::time::{Duration, Instant};

use hmac::{Hmac, Mac};
use sha2::Sha256;
use vizflyt_protocol::messages::{Grant, PairingProof, PairingRequest, PairingShare};

use super::{Binding, Code, PairingRole, Transcript, is, start};
use crate::paired::is_name;
use crate::{Client, Fingerprint, Role};

/// How long a code is good for.
pub const VALID: Duration = Duration::from_mins(2);
/// Wrong codes that a window bears.
pub const TRIES: u32 = 3;

/// Where computers are paired.
#[derive(Debug, Default)]
pub struct PairingServer {
    window: Option<Window>,
    /// Windows opened so far.
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

/// The open window, for the one who opened it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WindowState {
    /// What to type.
    pub code: Code,
    /// What it gives.
    pub grant: Grant,
    /// How long it is still good for.
    pub left: Duration,
    /// Wrong codes it still bears.
    pub tries_left: u32,
}

/// Why a computer is not paired, in a sentence for its user.
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
        /// Tries left.
        left: u32,
    },
    /// The proof is wrong for the last time.
    #[error("wrong code for the last time; open a new pairing for a new code")]
    Shut,
    /// The name cannot be shown to people.
    #[error("the computer's name must be 1 to 32 bytes of text; pass --name NAME")]
    Name,
    /// Not what is due.
    #[error("the other side does not pair as this version does; update the older of the two")]
    Foreign,
}

/// A client that has begun and must now show its proof.
pub struct Attempt {
    window: u64,
    name: String,
    fingerprint: Fingerprint,
    client: Hmac<Sha256>,
    server: Hmac<Sha256>,
}

/// A client that knew the code.
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
    /// Opens a window; false while one is open.
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

    /// Shuts the window.
    pub fn shut(&mut self) {
        self.window = None;
    }

    /// Returns the open window.
    pub fn state(&mut self, now: Instant) -> Option<WindowState> {
        self.at(now).map(|window| WindowState {
            code: window.code,
            grant: window.grant.clone(),
            left: window.until.saturating_duration_since(now),
            tries_left: window.tries_left,
        })
    }

    /// Takes a client's first message; returns the attempt and the server's half.
    ///
    /// An attempt that ends here has revealed nothing about the code to the client.
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

    /// Takes a client's proof. Right, it shuts the window; wrong, it takes one try.
    pub fn confirm(
        &mut self,
        now: Instant,
        attempt: Attempt,
        message: &PairingRequest,
    ) -> Result<Admitted, Refusal> {
        let PairingRequest::Confirm { proof } = message else { return Err(Refusal::Foreign) };
        // The window may have shut meanwhile, and another one opened.
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

    /// Returns the window, if it is open at `now`.
    fn at(&mut self, now: Instant) -> Option<&mut Window> {
        if self.window.as_ref().is_some_and(|window| now >= window.until) {
            self.window = None;
        }
        self.window.as_mut()
    }
}
