//! Who may change a bridge, and how they ask. Requests and answers travel in MAVLink's TUNNEL
//! message, so any way that carries MAVLink carries them. Reading is open; changing needs the key.
//!
//! A change carries a counter above the last one's and the first 16 bytes of HMAC-SHA256 over this
//! start's random bytes, that counter and the request, by the bridge's key: nobody forges one, and
//! a recorded one is worth nothing later. Until a bridge has a key it takes one change only: the
//! key (claiming). While the vehicle is armed nothing changes.
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
/// Bytes of a request or answer at most.
pub const BODY: usize = 128;
/// Bytes of the proof.
pub const PROOF: usize = 16;
/// Bytes before a request's body.
pub const HEAD: usize = 5;

/// What is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Op {
    /// Who are you.
    Hello = 1,
    /// The counters.
    Stats = 2,
    /// One setting.
    Read = 3,
    /// Change a setting.
    Set = 4,
    /// Keep the settings over a restart.
    Save = 5,
    /// Back to the settings of the first day; the key stays.
    Reset = 6,
    /// Restart the bridge.
    Restart = 7,
    /// Take this key; only while there is none.
    Claim = 8,
}

impl Op {
    /// Returns the request of a number.
    pub fn from_number(number: u8) -> Option<Self> {
        use Op::{Claim, Hello, Read, Reset, Restart, Save, Set, Stats};
        [Hello, Stats, Read, Set, Save, Reset, Restart, Claim]
            .into_iter()
            .find(|&op| op as u8 == number)
    }

    /// Whether it needs the key.
    pub fn changes(self) -> bool {
        matches!(self, Self::Set | Self::Save | Self::Reset | Self::Restart)
    }
}

/// How a request fared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Status {
    /// Done.
    Done = 0,
    /// There is no such request or setting.
    Unknown = 1,
    /// The value cannot be read.
    Malformed = 2,
    /// The value is outside its range.
    OutOfRange = 3,
    /// The proof is wrong, or the counter old.
    WrongKey = 4,
    /// The bridge has no key yet: claim it first.
    Unclaimed = 5,
    /// The bridge has a key already.
    Claimed = 6,
    /// The vehicle is armed.
    Armed = 7,
}

impl Status {
    /// Returns the status of a number.
    pub fn from_number(number: u8) -> Option<Self> {
        use Status::{Armed, Claimed, Done, Malformed, OutOfRange, Unclaimed, Unknown, WrongKey};
        [Done, Unknown, Malformed, OutOfRange, WrongKey, Unclaimed, Claimed, Armed]
            .into_iter()
            .find(|&status| status as u8 == number)
    }

    /// Returns it in words.
    pub fn message(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Unknown => "the bridge does not know it",
            Self::Malformed => "the value cannot be read",
            Self::OutOfRange => "the value is out of range",
            Self::WrongKey => "the key is wrong",
            Self::Unclaimed => "the bridge has no key yet; claim it first",
            Self::Claimed => {
                "the bridge has a key already; reset it at its button to claim it anew"
            }
            Self::Armed => "the vehicle is armed; disarm it first",
        }
    }
}

/// A change that asks the shell for something.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ShellRequest {
    Save,
    Reset,
    Restart,
}

/// What was proven so far in this start.
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

    /// Whether a request (its proof at the end) proves the key; takes its counter.
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

    /// Whether a packet is signed by the key, MAVLink's way, and newer than the last that was
    /// (MAVLink guide, "Message Signing").
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

/// Whether a packet is signed by the key, MAVLink's way, whenever that was.
pub(crate) fn is_signed_by(key: &Key, packet: Raw<'_>) -> bool {
    let Some(signed) = packet.signed_bytes() else { return false };
    let right = Sha256::new().chain_update(key).chain_update(signed).finalize();
    // Why: six bytes are compared at once; how long that takes carries no information on a hash.
    right[..6] == packet.bytes()[signed.len()..]
}

/// Returns what a bridge tells of its start's random bytes: proofs are over it, and the bytes themselves
/// stay a secret.
pub fn nonce(random: &[u8; 16]) -> [u8; 16] {
    derived(b"vizflyt bridge nonce", random)
}

/// Returns random bytes for a key that people type.
pub(crate) fn key_bytes(random: &[u8; 16]) -> [u8; 16] {
    derived(b"vizflyt bridge typed key", random)
}

fn derived(purpose: &[u8], random: &[u8; 16]) -> [u8; 16] {
    let whole = Sha256::new().chain_update(purpose).chain_update(random).finalize();
    core::array::from_fn(|at| whole[at])
}

/// Returns the proof of a request by a key, for [`PROOF`] bytes behind it.
pub fn proof(key: &Key, nonce: &[u8; 16], signed: &[u8]) -> [u8; PROOF] {
    let whole = mac(key, nonce, signed).finalize().into_bytes();
    core::array::from_fn(|at| whole[at])
}

fn mac(key: &Key, nonce: &[u8; 16], signed: &[u8]) -> Hmac<Sha256> {
    // HMAC fills a short key up with zeros to a block of the hash (RFC 2104, section 2).
    let mut block = [0; 64];
    block[..key.len()].copy_from_slice(key);
    let mut mac = <Hmac<Sha256> as Mac>::new(&block.into());
    mac.update(b"vizflyt bridge 1");
    mac.update(nonce);
    mac.update(signed);
    mac
}
