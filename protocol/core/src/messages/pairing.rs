//! Pairing: one-time exchange by which a computer and a server trust each other.
//!
//! Uses a QUIC connection with its own protocol name and one bidirectional stream that the client opens. After the
//! preambles:
//! ```text
//! client                                server
//!   Begin { name, share }  ---------->          pairing must be open on the server
//!                          <----------  Share { share }
//!   Confirm { proof }      ---------->          counts as an attempt; if wrong: Refused
//!                          <----------  Paired { proof, grant }
//! ```
//! The server may send `Refused` instead of any reply.

use serde::{Deserialize, Serialize};

use super::{Name, Text};

/// Share of one side in the key agreement (SPAKE2, RFC 9382), without the letter that identifies the side.
pub type PairingShare = [u8; 32];
/// Proof that a side derived the same key on the same connection.
pub type PairingProof = [u8; 32];
/// Maximum number of vehicles that one pairing grants to a team.
pub const MAX_GRANTED: usize = 8;

/// Client to server.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PairingRequest {
    /// Request to be paired.
    Begin {
        /// Name of this computer for display.
        name: Name,
        /// Share of the client.
        share: PairingShare,
    },
    /// Proof that the client has the key and therefore the code.
    Confirm {
        /// Proof of the client.
        proof: PairingProof,
    },
}

/// Server to client.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: there is no heap to box it on, and it comes once.
pub enum PairingReply {
    /// Share of the server.
    Share {
        /// Share of the server.
        share: PairingShare,
    },
    /// Pairing succeeded.
    Paired {
        /// Proof of the server.
        proof: PairingProof,
        /// Rights of the client.
        grant: Grant,
    },
    /// Pairing failed; with the reason and a remedy.
    Refused(Text),
}

/// Rights that a pairing grants.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: as above.
pub enum Grant {
    /// The right to fly and watch these vehicles.
    Team {
        /// Names of the vehicles.
        vehicles: heapless::Vec<Name, MAX_GRANTED>,
    },
    /// All rights.
    Instructor,
}
