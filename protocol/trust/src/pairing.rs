//! Pairing with a short code, sans-IO: a state machine for each side, driven by the other's messages.
//!
//! Both sides run SPAKE2 with the code as password. A man in the middle without the code gets a different key. One
//! attempt shows him only that one guess was wrong. Each side then proves its key with an HMAC over both certificates'
//! fingerprints, both shares, the name, and the TLS exporter of this connection. A relay between two connections
//! therefore fails even with the correct code, and recorded messages are useless later. The client sends its proof
//! first, and the server counts the attempt before it replies.

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

/// Code of six digits that a person reads on one screen and types on another.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Code([u8; 6]);

impl Code {
    /// Returns a uniformly random code from the system's generator.
    ///
    /// # Errors
    /// Returns an error if the system provides no random numbers.
    pub fn random() -> Result<Self, String> {
        let random = rustls::crypto::ring::default_provider().secure_random;
        loop {
            let mut bytes = [0; 4];
            random
                .fill(&mut bytes)
                .map_err(|_| "the system provides no random numbers".to_owned())?;
            let number = u32::from_le_bytes(bytes);
            // Why: otherwise low codes would be slightly more likely.
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

    /// Parses six digits; spaces and dashes are ignored.
    fn from_str(text: &str) -> Result<Self, String> {
        let digits: Vec<u8> = text.bytes().filter(|byte| !b" -\t\r\n".contains(byte)).collect();
        match <[u8; 6]>::try_from(digits) {
            Ok(digits) if digits.iter().all(u8::is_ascii_digit) => Ok(Self(digits)),
            _ => Err("a pairing code is six digits, for example 123 456".to_owned()),
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
    /// Hides the code: it must not be logged.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Code(..)")
    }
}

/// Connection on which a pairing takes place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    /// Fingerprint of the client, as seen by the server.
    pub client: Fingerprint,
    /// Fingerprint of the server, as seen by the client.
    pub server: Fingerprint,
    /// TLS exporter: derived by both ends of this connection only (RFC 8446, section 7.5), with [`EXPORTER_LABEL`] and
    /// no context.
    pub exporter: [u8; 32],
}

/// Label of [`Binding::exporter`].
pub const EXPORTER_LABEL: &[u8] = b"EXPORTER-vizflyt-pair";

/// Role in the key agreement.
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
    // The crate's message is one letter for the role, then the group element.
    let share = message[1..].try_into().expect("an element of Ed25519 has 32 bytes");
    (agreement, share)
}

/// Proofs of both sides of a completed agreement.
struct Proofs {
    client: Hmac<Sha256>,
    server: Hmac<Sha256>,
}

/// Data that both sides must have seen identically.
struct Transcript<'a> {
    binding: &'a Binding,
    name: &'a str,
    client_share: &'a PairingShare,
    server_share: &'a PairingShare,
}

impl Transcript<'_> {
    /// Completes the agreement in `role`; `None` if the other side's share is not a group element.
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

/// Number of possible codes.
const CODES: u32 = 1_000_000;
