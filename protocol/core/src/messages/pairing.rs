//! Pairing: the conversation by which a computer and a server come to know each other, once.
//!
//! On a QUIC connection of its own protocol name, on one bidirectional stream that the client
//! opens: preambles, then
//! ```text
//! client                                server
//!   Begin { name, share }  ---------->          a window must be open
//!                          <----------  Share { share }
//!   Confirm { proof }      ---------->          counts as a try; wrong: Refused
//!                          <----------  Paired { proof, grant }
//! ```
//! `Refused` may come instead of any answer.

use serde::{Deserialize, Serialize};

use super::{Name, Text};

/// One side's half of the key agreement (SPAKE2, RFC 9382), without the letter of its side.
pub type PairingShare = [u8; 32];
/// Proof of having agreed on the same key over the same connection.
pub type PairingProof = [u8; 32];
/// Most vehicles a team is granted by one pairing.
pub const MAX_GRANTED: usize = 8;

/// Client to server.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PairingRequest {
    /// Asks to be paired.
    Begin {
        /// What people shall call this computer.
        name: Name,
        /// Its half.
        share: PairingShare,
    },
    /// Shows that it has the key, and so the code.
    Confirm {
        /// The client's proof.
        proof: PairingProof,
    },
}

/// Server to client.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: there is no heap to box it on, and it comes once.
pub enum PairingReply {
    /// The server's half.
    Share {
        /// It.
        share: PairingShare,
    },
    /// Done.
    Paired {
        /// The server's proof.
        proof: PairingProof,
        /// What the client may do from now on.
        grant: Grant,
    },
    /// Not done; the reason, and what to do.
    Refused(Text),
}

/// What a pairing gives.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: as above.
pub enum Grant {
    /// Flying and watching these vehicles.
    Team {
        /// Their names.
        vehicles: heapless::Vec<Name, MAX_GRANTED>,
    },
    /// Everything.
    Instructor,
}
