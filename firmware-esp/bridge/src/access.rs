//! Access control of a bridge's configuration. Requests and answers travel in MAVLink's TUNNEL message, so every
//! MAVLink connection carries them. Reading is open; changes need the key.
//!
//! A change contains a counter, larger than that of the previous change, and the first 16 bytes of an HMAC-SHA256. The
//! HMAC uses the bridge's key and covers a nonce of this start, the counter and the request. This prevents forgery and
//! replay. A bridge without a key accepts only one change: the key itself (claiming). While the vehicle is armed, all
//! changes are refused.
//!
//! ```text
//! request   op, counter (u32), body, [16 bytes of HMAC if it changes something]
//! answer    op | 0x80, status, body
//! HELLO     -> nonce (16), counter (u32), flags (1 claimed, 2 armed, 4 transparent), version text
//! STATS     -> counters (u32 each), see `report`
//! READ      name -> value
//! SET       name = value      SAVE, RESET, RESTART: no body      CLAIM: 32 bytes of key
//! ```

use hmac::{Hmac, Mac};
use sha2::{Digest, Sha256};

use crate::packet::Raw;
use crate::settings::Key;

/// TUNNEL's payload type, of the range that MAVLink leaves to private use (32768 up).
pub const TUNNEL_TYPE: u16 = 0x9F17;
/// Maximum length of a request or answer [bytes].
pub const BODY: usize = 128;
/// Length of the proof [bytes].
pub const PROOF: usize = 16;
/// Length of the header before a request's body [bytes].
pub const HEAD: usize = 5;

/// Operation of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Op {
    /// Returns nonce, counter, flags and version.
    Hello = 1,
    /// Returns the counters.
    Stats = 2,
    /// Returns one setting.
    Read = 3,
    /// Changes a setting.
    Set = 4,
    /// Saves the settings to flash.
    Save = 5,
    /// Restores the default settings, except keys and network password.
    Reset = 6,
    /// Restarts the bridge.
    Restart = 7,
    /// Sets the bridge's key; refused if it already has one.
    Claim = 8,
}

impl Op {
    /// Returns the operation with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        use Op::{Claim, Hello, Read, Reset, Restart, Save, Set, Stats};
        [Hello, Stats, Read, Set, Save, Reset, Restart, Claim]
            .into_iter()
            .find(|&op| op as u8 == number)
    }

    /// Whether the operation needs the key.
    pub fn changes(self) -> bool {
        matches!(self, Self::Set | Self::Save | Self::Reset | Self::Restart)
    }
}

/// Result of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Status {
    /// The request was executed.
    Done = 0,
    /// Unknown operation or setting.
    Unknown = 1,
    /// The value cannot be parsed.
    Malformed = 2,
    /// The value is outside its range.
    OutOfRange = 3,
    /// The proof is wrong, or its counter is too old.
    WrongKey = 4,
    /// The bridge has no key yet; claim it first.
    Unclaimed = 5,
    /// The bridge already has a key.
    Claimed = 6,
    /// The vehicle is armed.
    Armed = 7,
}

impl Status {
    /// Returns the status with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        use Status::{Armed, Claimed, Done, Malformed, OutOfRange, Unclaimed, Unknown, WrongKey};
        [Done, Unknown, Malformed, OutOfRange, WrongKey, Unclaimed, Claimed, Armed]
            .into_iter()
            .find(|&status| status as u8 == number)
    }

    /// Returns the status in words.
    pub fn message(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Unknown => "unknown request or setting",
            Self::Malformed => "the value cannot be read",
            Self::OutOfRange => "the value is out of range",
            Self::WrongKey => "the key is wrong",
            Self::Unclaimed => "the bridge has no key yet; claim it first",
            Self::Claimed => {
                "the bridge has a key already; reset it at its button to claim it again"
            }
            Self::Armed => "the vehicle is armed; disarm it first",
        }
    }
}

/// Request that the router passes to the shell or to the settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ShellRequest {
    Save,
    Reset,
    Restart,
}

/// Proofs that were accepted since the start.
#[derive(Clone, Debug)]
pub(crate) struct Access {
    pub(crate) nonce: [u8; 16],
    pub(crate) counter: u32,
    /// Newest time stamp of a signed packet. [10 us since 2015]
    signed_at: u64,
}

impl Access {
    pub(crate) const fn new(nonce: [u8; 16]) -> Self {
        Self { nonce, counter: 0, signed_at: 0 }
    }

    /// Whether the proof at the end of a request is valid for the key and its counter is new. Stores the counter.
    pub(crate) fn proves(&mut self, key: &Key, request: &[u8]) -> bool {
        let Some(at) = request.len().checked_sub(PROOF).filter(|&at| at >= HEAD) else {
            return false;
        };
        let (signed, given) = request.split_at(at);
        let counter = u32::from_le_bytes([signed[1], signed[2], signed[3], signed[4]]);
        let right = mac(key, &self.nonce, signed).verify_truncated_left(given).is_ok();
        if right && counter > self.counter {
            self.counter = counter;
            return true;
        }
        false
    }

    /// Whether a packet has a MAVLink signature by the key, newer than that of the last accepted packet (MAVLink guide,
    /// "Message Signing").
    pub(crate) fn signed_by(&mut self, key: Option<&Key>, packet: Raw<'_>) -> bool {
        let Some(key) = key else { return false };
        let signed_at = packet.signed_at();
        let fresh = signed_at > self.signed_at && is_signed_by(key, packet);
        if fresh {
            self.signed_at = signed_at;
        }
        fresh
    }
}

/// Whether a packet has a MAVLink signature by the key, of any age.
pub(crate) fn is_signed_by(key: &Key, packet: Raw<'_>) -> bool {
    let Some(signed) = packet.signed_bytes() else { return false };
    let right = Sha256::new().chain_update(key).chain_update(signed).finalize();
    // Why: a comparison of hashes leaks no secret through its time.
    right[..6] == packet.bytes()[signed.len()..]
}

/// Returns the nonce of this start, derived from its random bytes. Proofs cover the nonce; the bytes themselves stay
/// secret.
pub fn nonce(random: &[u8; 16]) -> [u8; 16] {
    derived(b"vizflyt bridge nonce", random)
}

/// Returns random bytes for a key that users type.
pub(crate) fn key_bytes(random: &[u8; 16]) -> [u8; 16] {
    derived(b"vizflyt bridge typed key", random)
}

fn derived(purpose: &[u8], random: &[u8; 16]) -> [u8; 16] {
    let whole = Sha256::new().chain_update(purpose).chain_update(random).finalize();
    core::array::from_fn(|at| whole[at])
}

/// Returns the proof of a request: [`PROOF`] bytes to append to it.
pub fn proof(key: &Key, nonce: &[u8; 16], signed: &[u8]) -> [u8; PROOF] {
    let whole = mac(key, nonce, signed).finalize().into_bytes();
    core::array::from_fn(|at| whole[at])
}

fn mac(key: &Key, nonce: &[u8; 16], signed: &[u8]) -> Hmac<Sha256> {
    // HMAC pads a short key with zeros to a block of the hash (RFC 2104, section 2).
    let mut block = [0; 64];
    block[..key.len()].copy_from_slice(key);
    let mut mac = <Hmac<Sha256> as Mac>::new(&block.into());
    mac.update(b"vizflyt bridge 1");
    mac.update(nonce);
    mac.update(signed);
    mac
}
