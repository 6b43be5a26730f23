//! Pairing by a short code, sans-IO: each side's state machine, fed with the other's messages.
//!
//! Both run SPAKE2 with the code as password. Whoever sits in between without the code agrees on
//! another key, and learns from one attempt that one guess was wrong, nothing more. Each side then
//! proves the key with an HMAC over both certificates' fingerprints, both halves, the name, and
//! the TLS exporter of this very connection: so a relay between two connections fails even while
//! the code is right, and nothing recorded is of use later. The client proves first; the server
//! counts a try before it answers.

mod client;
mod server;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

use hmac::{Hmac, Mac};
use sha2::{Digest, Sha256};
use spake2::{Ed25519Group, Password, Spake2};
use vizflyt_protocol::messages::{PairingProof, PairingShare};

use crate::Fingerprint;

pub use client::{Confirming, PairingClient};
pub use server::{Admitted, Attempt, PairingServer, Refusal, TRIES, VALID, WindowState};

/// Six digits that a person reads on one screen and types on another.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Code([u8; 6]);

impl Code {
    /// Returns a uniformly random code from the system's generator.
    ///
    /// # Errors
    /// If the system gives none.
    pub fn random() -> Result<Self, String> {
        let random = rustls::crypto::ring::default_provider().secure_random;
        loop {
            let mut bytes = [0; 4];
            random.fill(&mut bytes).map_err(|_| "the system gives no random numbers".to_owned())?;
            let number = u32::from_le_bytes(bytes);
            // Why: without this the low codes would be slightly likelier.
            if number < u32::MAX / CODES * CODES {
                return Ok(Self::from_number(number % CODES));
            }
        }
    }

    fn from_number(mut number: u32) -> Self {
        let mut digits = [b'0'; 6];
        for digit in digits.iter_mut().rev() {
            *digit = b'0' + (number % 10) as u8;
            number /= 10;
        }
        Self(digits)
    }
}

impl FromStr for Code {
    type Err = String;

    /// Reads six digits; spaces and dashes between them are skipped.
    fn from_str(text: &str) -> Result<Self, String> {
        let digits: Vec<u8> = text.bytes().filter(|byte| !b" -\t\r\n".contains(byte)).collect();
        match <[u8; 6]>::try_from(digits) {
            Ok(digits) if digits.iter().all(u8::is_ascii_digit) => Ok(Self(digits)),
            _ => Err("a pairing code is six digits, as 123 456".to_owned()),
        }
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = String::from_utf8_lossy(&self.0);
        write!(f, "{} {}", &text[..3], &text[3..])
    }
}

impl fmt::Debug for Code {
    /// A code does not belong in a log.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Code(..)")
    }
}

/// The connection that a pairing happens on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    /// Whom the server sees.
    pub client: Fingerprint,
    /// Whom the client sees.
    pub server: Fingerprint,
    /// What TLS derives for both ends of this connection alone (RFC 8446, section 7.5), with
    /// [`EXPORTER_LABEL`] and no context.
    pub exporter: [u8; 32],
}

/// Label of [`Binding::exporter`].
pub const EXPORTER_LABEL: &[u8] = b"EXPORTER-vizflyt-pair";

/// Which role in the key agreement.
#[derive(Clone, Copy, PartialEq, Eq)]
enum PairingRole {
    /// The client.
    A,
    /// The server.
    B,
}

type Agreement = Spake2<Ed25519Group>;

fn start(role: PairingRole, code: Code) -> (Agreement, PairingShare) {
    let (a, b) =
        (spake2::Identity::new(b"vizflyt client"), spake2::Identity::new(b"vizflyt server"));
    let password = Password::new(code.0);
    let (agreement, message) = match role {
        PairingRole::A => Agreement::start_a(&password, &a, &b),
        PairingRole::B => Agreement::start_b(&password, &a, &b),
    };
    // The crate's message is one letter for the side, then the group element.
    let share = message[1..].try_into().expect("an element of Ed25519 has 32 bytes");
    (agreement, share)
}

/// Both proofs of an agreement that came about.
struct Proofs {
    client: Hmac<Sha256>,
    server: Hmac<Sha256>,
}

/// What both must have seen alike.
struct Transcript<'a> {
    binding: &'a Binding,
    name: &'a str,
    client_share: &'a PairingShare,
    server_share: &'a PairingShare,
}

impl Transcript<'_> {
    /// Finishes the agreement of `role`; `None` if the other's half is no group element.
    fn prove(&self, role: PairingRole, agreement: Agreement) -> Option<Proofs> {
        let (letter, theirs) = match role {
            PairingRole::A => (b'B', self.server_share),
            PairingRole::B => (b'A', self.client_share),
        };
        let mut message = vec![letter];
        message.extend_from_slice(theirs);
        let key = agreement.finish(&message).ok()?;
        let hash = Sha256::new()
            .chain_update(b"vizflyt pairing 1")
            .chain_update(self.binding.client.as_bytes())
            .chain_update(self.binding.server.as_bytes())
            .chain_update(self.binding.exporter)
            .chain_update(self.client_share)
            .chain_update(self.server_share)
            .chain_update((self.name.len() as u64).to_le_bytes())
            .chain_update(self.name.as_bytes())
            .finalize();
        let proof = |who: &[u8]| {
            let mac = <Hmac<Sha256> as Mac>::new_from_slice(&key).ok()?;
            Some(mac.chain_update(who).chain_update(hash))
        };
        Some(Proofs { client: proof(b"client")?, server: proof(b"server")? })
    }
}

/// Compares in constant time.
fn is(expected: Hmac<Sha256>, proof: &PairingProof) -> bool {
    expected.verify_slice(proof).is_ok()
}

/// How many codes there are.
const CODES: u32 = 1_000_000;
