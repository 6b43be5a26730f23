//! MAVLink 2 message signing: only holders of the key are accepted, and no packet can be replayed
//! (MAVLink guide, "Message Signing"). Pure: bytes and the time in, bytes or a refusal out.
//!
//! A signed packet carries 13 bytes more: link id, a 48-bit stamp in units of 10 us since 2015, and
//! the first 6 bytes of SHA-256(key, header, payload, checksum, link id, stamp).

use heapless::Vec;
use sha2::{Digest, Sha256};

use super::dialect::MavMessage;
use super::stream::{MAX_PACKET, STX_V2};
use ::mavlink::{Message, calculate_crc};

/// Bytes that a signature adds to a packet.
pub const SIGNATURE: usize = 13;

/// The secret that both ends share.
#[derive(Clone, PartialEq, Eq)]
pub struct SigningKey([u8; 32]);

impl SigningKey {
    /// Makes a key of its bytes.
    pub const fn new(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// Returns its bytes, as SETUP_SIGNING carries them.
    pub const fn bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl core::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("SigningKey(secret)")
    }
}

/// A stamp of a signature: 10 us since 2015-01-01 00:00 UTC, 48 bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct SigningTime(u64);

impl SigningTime {
    /// Makes a stamp of its number; beyond 48 bits it stays at the end (2104).
    pub const fn from_units(units: u64) -> Self {
        Self(if units < 1 << 48 { units } else { (1 << 48) - 1 })
    }

    /// Makes a stamp of microseconds since 1970; before 2015 it is zero. [us]
    ///
    /// ```
    /// use vizflyt_protocol::mavlink::SigningTime;
    /// assert_eq!(SigningTime::from_unix_us(1_420_070_400_000_020).units(), 2);
    /// ```
    pub const fn from_unix_us(unix_us: u64) -> Self {
        Self::from_units(unix_us.saturating_sub(1_420_070_400_000_000) / 10)
    }

    /// Returns its number. [10 us]
    pub const fn units(self) -> u64 {
        self.0
    }

    /// Returns the stamp `us` later. [us]
    pub const fn plus_us(self, us: u64) -> Self {
        Self::from_units(self.0.saturating_add(us / 10))
    }
}

/// Why a packet is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SigningFault {
    /// It carries no signature.
    #[error("a packet is not signed")]
    Unsigned,
    /// Its signature is not of our key, or the packet was changed.
    #[error("a packet is signed with another key, or was changed")]
    Forged,
    /// Its stamp is not newer than one received before, or a minute old.
    #[error("a packet is a replay")]
    Replayed,
    /// More senders than can be kept apart.
    #[error("more than 16 senders sign")]
    TooMany,
}

/// Signs what one end sends.
#[derive(Clone, Debug)]
pub struct Signer {
    key: SigningKey,
    link: u8,
    next: u64,
}

impl Signer {
    /// Makes a signer; `link` distinguishes several links of one sender.
    pub const fn new(key: SigningKey, link: u8) -> Self {
        Self { key, link, next: 0 }
    }

    /// Signs the MAVLink 2 packet that is the first `len` bytes of `buffer`; returns its new length.
    /// A packet that is none, or signed already, stays as it is.
    pub fn sign(&mut self, now: SigningTime, buffer: &mut [u8; MAX_PACKET], len: usize) -> usize {
        let whole = len >= 12 && len + SIGNATURE <= MAX_PACKET;
        if !whole
            || buffer[0] != STX_V2
            || buffer[2] & SIGNED != 0
            || 12 + usize::from(buffer[1]) != len
        {
            return len;
        }
        buffer[2] |= SIGNED;
        let id = u32::from_le_bytes([buffer[7], buffer[8], buffer[9], 0]);
        let crc = calculate_crc(&buffer[1..len - 2], MavMessage::extra_crc(id));
        buffer[len - 2..len].copy_from_slice(&crc.to_le_bytes());
        // Every packet needs a stamp of its own, also within 10 us, and when the clock falls back.
        let stamp = self.next.max(now.units());
        self.next = stamp + 1;
        buffer[len] = self.link;
        buffer[len + 1..len + 7].copy_from_slice(&stamp.to_le_bytes()[..6]);
        let signature = signature(&self.key, &buffer[..len + 7]);
        buffer[len + 7..len + SIGNATURE].copy_from_slice(&signature);
        len + SIGNATURE
    }
}

/// Verifies what one end receives.
#[derive(Clone, Debug)]
pub struct Verifier {
    key: SigningKey,
    newest: u64,
    /// Newest stamp of each (system, component, link).
    senders: Vec<([u8; 3], u64), SENDERS>,
}

/// Senders kept apart. A vehicle's link has two or three.
const SENDERS: usize = 16;
/// A sender received for the first time may be this much behind. [10 us]
const MINUTE: u64 = 6_000_000;

impl Verifier {
    /// Makes one that has received nothing.
    pub const fn new(key: SigningKey) -> Self {
        Self { key, newest: 0, senders: Vec::new() }
    }

    /// Judges a whole packet, whose checksum is right; remembers its stamp if it is accepted.
    ///
    /// # Errors
    /// [`SigningFault`].
    pub fn check(&mut self, now: SigningTime, packet: &[u8]) -> Result<(), SigningFault> {
        if !is_signed(packet) {
            return Err(SigningFault::Unsigned);
        }
        let (signed_bytes, theirs) = packet.split_at(packet.len() - 6);
        let ours = signature(&self.key, signed_bytes);
        // In constant time: a forger learns nothing from how long it took.
        if ours.iter().zip(theirs).fold(0, |differ, (a, b)| differ | (a ^ b)) != 0 {
            return Err(SigningFault::Forged);
        }
        let tail = &signed_bytes[signed_bytes.len() - 7..];
        let stamp =
            u64::from_le_bytes([tail[1], tail[2], tail[3], tail[4], tail[5], tail[6], 0, 0]);
        let sender = [packet[5], packet[6], tail[0]];
        self.newest = self.newest.max(now.units());
        match self.senders.iter_mut().find(|(known, _)| *known == sender) {
            Some((_, last)) if stamp <= *last => return Err(SigningFault::Replayed),
            Some((_, last)) => *last = stamp,
            None if stamp + MINUTE < self.newest => return Err(SigningFault::Replayed),
            None => {
                self.senders.push((sender, stamp)).map_err(|_| SigningFault::TooMany)?;
            }
        }
        self.newest = self.newest.max(stamp);
        Ok(())
    }
}

/// Incompatibility flag of MAVLink 2: a signature follows.
const SIGNED: u8 = 0x01;

/// Whether a whole packet carries a signature, right or wrong.
pub fn is_signed(packet: &[u8]) -> bool {
    packet.len() >= 12 + SIGNATURE && packet[0] == STX_V2 && packet[2] & SIGNED != 0
}

/// Returns the signature of a packet up to and with its stamp.
fn signature(key: &SigningKey, signed_bytes: &[u8]) -> [u8; 6] {
    let mut hash = Sha256::new();
    hash.update(key.0);
    hash.update(signed_bytes);
    let digest = hash.finalize();
    [digest[0], digest[1], digest[2], digest[3], digest[4], digest[5]]
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::dialect::{HEARTBEAT_DATA, MavState};
    use super::super::stream::{StreamDecoder, encode};
    use super::*;
    use ::mavlink::MavHeader;
    use proptest::prelude::*;

    /// Two packets signed by pymavlink 2.4: key 0, 1, ... 31, link 3, stamps from 3 700 000 000 000.
    const PYMAVLINK: &str = "fd0901000001010000000400000002035104039c560300882f795d033d91e7a2b827\
        fd1c0100010101200000d20400000000c03f000000c0000000bfcdcccc3dcdcc4c3e9a99993e10fa0301882f795d\
        03cac5966a175f";
    const NOW: SigningTime = SigningTime::from_units(3_700_000_000_000);

    fn key() -> SigningKey {
        SigningKey::new(core::array::from_fn(|i| i as u8))
    }

    fn their_packets() -> std::vec::Vec<std::vec::Vec<u8>> {
        let hex: std::string::String = PYMAVLINK.chars().filter(|c| !c.is_whitespace()).collect();
        let bytes: std::vec::Vec<u8> = (0..hex.len() / 2)
            .map(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).unwrap())
            .collect();
        let mut packets = std::vec::Vec::new();
        StreamDecoder::default().push_whole(&bytes, |bytes, _| packets.push(bytes.to_vec()));
        packets
    }

    fn signed(signer: &mut Signer, now: SigningTime, system: u32) -> ([u8; MAX_PACKET], usize) {
        let header = MavHeader { system_id: system, component_id: 1, sequence: 4 };
        let message = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            system_status: MavState::MAV_STATE_ACTIVE,
            ..Default::default()
        });
        let mut buffer = [0; MAX_PACKET];
        let len = encode(header, &message, &mut buffer).len();
        let len = signer.sign(now, &mut buffer, len);
        (buffer, len)
    }

    #[test]
    fn pymavlinks_signatures_are_accepted_and_made_alike() {
        let packets = their_packets();
        assert_eq!(packets.len(), 2);
        let mut verifier = Verifier::new(key());
        for packet in &packets {
            assert_eq!(verifier.check(NOW, packet), Ok(()));
        }
        // Their unsigned packet, signed by us, is theirs to the bit.
        let mut signer = Signer::new(key(), 3);
        for theirs in &packets {
            let len = theirs.len() - SIGNATURE;
            let mut buffer = [0; MAX_PACKET];
            buffer[..len].copy_from_slice(&theirs[..len]);
            buffer[2] = 0;
            let len = signer.sign(NOW, &mut buffer, len);
            assert_eq!(&buffer[..len], theirs);
        }
    }

    #[test]
    fn unsigned_forged_and_replayed_packets_are_refused() {
        let (mut signer, mut verifier) = (Signer::new(key(), 0), Verifier::new(key()));
        let (packet, len) = signed(&mut signer, NOW, 1);
        assert_eq!(verifier.check(NOW, &packet[..len]), Ok(()));
        assert_eq!(verifier.check(NOW, &packet[..len]), Err(SigningFault::Replayed));
        let (packet, len) = signed(&mut signer, NOW, 1);
        for at in 0..len {
            let mut changed = packet;
            changed[at] ^= 0x10;
            let verdict = verifier.check(NOW, &changed[..len]);
            assert!(matches!(verdict, Err(SigningFault::Forged | SigningFault::Unsigned)), "{at}");
        }
        assert_eq!(verifier.check(NOW, &packet[..len]), Ok(()), "stamps rise within 10 us");
        let (packet, len) = signed(&mut Signer::new(SigningKey::new([7; 32]), 0), NOW, 1);
        assert_eq!(verifier.check(NOW, &packet[..len]), Err(SigningFault::Forged));
        let (packet, len) = signed(&mut signer, NOW, 1);
        assert_eq!(verifier.check(NOW, &packet[..len - SIGNATURE]), Err(SigningFault::Unsigned));
    }

    #[test]
    fn a_new_sender_may_be_a_minute_late_and_no_more() {
        let check = |late_us: u64, expected| {
            let mut verifier = Verifier::new(key());
            let (packet, len) = signed(&mut Signer::new(key(), 0), NOW, 1);
            assert_eq!(verifier.check(NOW.plus_us(late_us), &packet[..len]), expected);
        };
        check(59_000_000, Ok(()));
        check(61_000_000, Err(SigningFault::Replayed));
    }

    #[test]
    fn senders_are_kept_apart_up_to_a_limit() {
        let mut verifier = Verifier::new(key());
        for system in 1..=17 {
            let (packet, len) = signed(&mut Signer::new(key(), 0), NOW, system);
            let expected = if system <= 16 { Ok(()) } else { Err(SigningFault::TooMany) };
            assert_eq!(verifier.check(NOW, &packet[..len]), expected);
        }
    }

    proptest! {
        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Verifier::new(key()).check(NOW, &bytes).is_err());
        }
    }
}
