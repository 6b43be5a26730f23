//! MAVLink 2 message signing: only packets from holders of the key are accepted, and replayed packets are rejected
//! (MAVLink guide, "Message Signing"). Pure: input is bytes and the time, output is bytes or an error.
//!
//! A signed packet has 13 additional bytes: link id, a 48-bit time stamp in units of 10 us since 2015, and the first 6
//! bytes of SHA-256(key, header, payload, checksum, link id, time stamp).

use heapless::Vec;
use sha2::{Digest, Sha256};

use super::dialect::MavMessage;
use super::stream::{MAX_PACKET, STX_V2};
use ::mavlink::{Message, calculate_crc};

/// Number of bytes that a signature adds to a packet.
pub const SIGNATURE: usize = 13;

/// Secret shared by both ends.
#[derive(Clone, PartialEq, Eq)]
pub struct SigningKey([u8; 32]);

impl SigningKey {
    /// Returns the key with these bytes.
    pub const fn new(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// Returns the bytes of the key, as sent in SETUP_SIGNING.
    pub const fn bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl core::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("SigningKey(secret)")
    }
}

/// Time stamp of a signature: units of 10 us since 2015-01-01 00:00 UTC, 48 bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct SigningTime(u64);

impl SigningTime {
    /// Returns the stamp with this number of units; saturates at 48 bits (in the year 2104).
    pub const fn from_units(units: u64) -> Self {
        Self(if units < 1 << 48 { units } else { (1 << 48) - 1 })
    }

    /// Returns the stamp for microseconds since 1970; zero before 2015. [us]
    ///
    /// ```
    /// use vizflyt_protocol::mavlink::SigningTime;
    /// assert_eq!(SigningTime::from_unix_us(1_420_070_400_000_020).units(), 2);
    /// ```
    pub const fn from_unix_us(unix_us: u64) -> Self {
        Self::from_units(unix_us.saturating_sub(1_420_070_400_000_000) / 10)
    }

    /// Returns the number of units. [10 us]
    pub const fn units(self) -> u64 {
        self.0
    }

    /// Returns the stamp `us` later. [us]
    pub const fn plus_us(self, us: u64) -> Self {
        Self::from_units(self.0.saturating_add(us / 10))
    }
}

/// Reason for rejecting a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SigningFault {
    /// The packet has no signature.
    #[error("a packet is not signed")]
    Unsigned,
    /// The signature was made with another key, or the packet was changed.
    #[error("a packet is signed with another key, or was changed")]
    Forged,
    /// The stamp is not newer than that of an earlier packet, or it is more than a minute old.
    #[error("a packet is a replay")]
    Replayed,
}

/// Signs the packets of one sender.
#[derive(Clone, Debug)]
pub struct Signer {
    key: SigningKey,
    link: u8,
    next: u64,
}

impl Signer {
    /// Returns a signer. `link` distinguishes several links of one sender.
    pub const fn new(key: SigningKey, link: u8) -> Self {
        Self { key, link, next: 0 }
    }

    /// Signs the MAVLink 2 packet in the first `len` bytes of `buffer`. Returns its new length. An invalid or already
    /// signed packet is not changed.
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
        // Each packet needs a unique stamp, even within 10 us and if the clock steps back.
        let stamp = self.next.max(now.units());
        self.next = stamp + 1;
        buffer[len] = self.link;
        buffer[len + 1..len + 7].copy_from_slice(&stamp.to_le_bytes()[..6]);
        let signature = signature(&self.key, &buffer[..len + 7]);
        buffer[len + 7..len + SIGNATURE].copy_from_slice(&signature);
        len + SIGNATURE
    }
}

/// Verifies received packets.
///
/// A new verifier has no stamps: until the first packet of a sender, it also accepts a recording of that sender that is
/// at most a minute old, as MAVLink specifies.
#[derive(Clone, Debug)]
pub struct Verifier {
    key: SigningKey,
    newest: u64,
    /// Newest stamp for each (system, component, link).
    senders: Vec<([u8; 3], u64), SENDERS>,
    /// Newest stamp of all evicted senders: an unknown sender must exceed it, because it may be one of them.
    evicted: u64,
}

/// Maximum number of senders stored. A vehicle's link has two or three.
const SENDERS: usize = 16;
/// Maximum age of the first packet from a sender. [10 us]
const MINUTE: u64 = 6_000_000;

impl Verifier {
    /// Returns a verifier without known senders.
    pub const fn new(key: SigningKey) -> Self {
        Self { key, newest: 0, senders: Vec::new(), evicted: 0 }
    }

    /// Verifies a complete packet with a valid checksum. Stores its stamp if it is accepted.
    ///
    /// # Errors
    /// Returns the reason for rejecting the packet.
    pub fn check(&mut self, now: SigningTime, packet: &[u8]) -> Result<(), SigningFault> {
        if !is_signed(packet) {
            return Err(SigningFault::Unsigned);
        }
        let (signed_bytes, theirs) = packet.split_at(packet.len() - 6);
        let ours = signature(&self.key, signed_bytes);
        // Constant time: the duration gives a forger no information.
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
            None if stamp + MINUTE < self.newest || stamp <= self.evicted => {
                return Err(SigningFault::Replayed);
            }
            None => self.add(sender, stamp),
        }
        self.newest = self.newest.max(stamp);
        Ok(())
    }

    /// Adds a sender. If the table is full, it replaces the one with the oldest stamp.
    fn add(&mut self, sender: [u8; 3], stamp: u64) {
        let Err(new) = self.senders.push((sender, stamp)) else { return };
        if let Some(oldest) = self.senders.iter_mut().min_by_key(|(_, last)| *last) {
            self.evicted = self.evicted.max(oldest.1);
            *oldest = new;
        }
    }
}

/// Incompatibility flag of MAVLink 2: the packet is signed.
const SIGNED: u8 = 0x01;

/// Whether a complete packet contains a signature, valid or not.
pub fn is_signed(packet: &[u8]) -> bool {
    packet.len() >= 12 + SIGNATURE && packet[0] == STX_V2 && packet[2] & SIGNED != 0
}

/// Returns the signature of a packet, computed over all bytes up to and including the stamp.
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
    fn signatures_match_those_of_pymavlink() {
        let packets = their_packets();
        assert_eq!(packets.len(), 2);
        let mut verifier = Verifier::new(key());
        for packet in &packets {
            assert_eq!(verifier.check(NOW, packet), Ok(()));
        }
        // Packets signed by this module are identical to pymavlink's.
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
    fn rejects_unsigned_forged_and_replayed_packets() {
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
        assert_eq!(verifier.check(NOW, &packet[..len]), Ok(()), "stamps increase within 10 us");
        let (packet, len) = signed(&mut Signer::new(SigningKey::new([7; 32]), 0), NOW, 1);
        assert_eq!(verifier.check(NOW, &packet[..len]), Err(SigningFault::Forged));
        let (packet, len) = signed(&mut signer, NOW, 1);
        assert_eq!(verifier.check(NOW, &packet[..len - SIGNATURE]), Err(SigningFault::Unsigned));
    }

    #[test]
    fn accepts_a_new_sender_up_to_a_minute_late() {
        let check = |late_us: u64, expected| {
            let mut verifier = Verifier::new(key());
            let (packet, len) = signed(&mut Signer::new(key(), 0), NOW, 1);
            assert_eq!(verifier.check(NOW.plus_us(late_us), &packet[..len]), expected);
        };
        check(59_000_000, Ok(()));
        check(61_000_000, Err(SigningFault::Replayed));
    }

    #[test]
    fn a_full_table_accepts_new_senders_and_no_replays() {
        let mut verifier = Verifier::new(key());
        let mut recorded = std::vec::Vec::new();
        let mut autopilot = Signer::new(key(), 0);
        let mut now = NOW;
        for system in 2..=200 {
            now = now.plus_us(100_000);
            for (packet, len) in
                [signed(&mut autopilot, now, 1), signed(&mut Signer::new(key(), 0), now, system)]
            {
                assert_eq!(verifier.check(now, &packet[..len]), Ok(()), "system {system}");
                recorded.push((packet, len));
            }
        }
        // All of the recording is less than a minute old, and most of its senders were evicted.
        for (packet, len) in &recorded {
            assert_eq!(verifier.check(now, &packet[..*len]), Err(SigningFault::Replayed));
        }
        let (packet, len) = signed(&mut Signer::new(key(), 0), now.plus_us(10), 2);
        assert_eq!(verifier.check(now, &packet[..len]), Ok(()), "an evicted sender returns");
    }

    #[test]
    fn strangers_take_no_place_in_the_table() {
        let mut verifier = Verifier::new(key());
        let mut stranger = Signer::new(SigningKey::new([7; 32]), 0);
        for system in 2..=255 {
            let (packet, len) = signed(&mut stranger, NOW, system);
            assert_eq!(verifier.check(NOW, &packet[..len]), Err(SigningFault::Forged));
        }
        assert!(verifier.senders.is_empty());
    }

    /// A recording of the last two minutes, replayed to a running receiver and to one that has just started.
    #[test]
    fn rejects_a_recording_after_a_restart() {
        let (mut signer, mut running) = (Signer::new(key(), 0), Verifier::new(key()));
        let mut recorded = std::vec::Vec::new();
        for second in 0..120 {
            let at = NOW.plus_us(second * 1_000_000);
            let (packet, len) = signed(&mut signer, at, 1);
            assert_eq!(running.check(at, &packet[..len]), Ok(()));
            recorded.push((packet, len));
        }
        let now = NOW.plus_us(120_000_000);
        let accepted = |verifier: &mut Verifier| {
            let check = |(packet, len): &&([u8; MAX_PACKET], usize)| {
                verifier.check(now, &packet[..*len]).is_ok()
            };
            recorded.iter().filter(check).count()
        };
        assert_eq!(accepted(&mut running), 0);
        // MAVLink's rule: at most the last minute, and only before the first packet of the true sender.
        assert_eq!(accepted(&mut Verifier::new(key())), 60);
        let mut fresh = Verifier::new(key());
        let (packet, len) = signed(&mut signer, now, 1);
        assert_eq!(fresh.check(now, &packet[..len]), Ok(()));
        assert_eq!(accepted(&mut fresh), 0);
    }

    proptest! {
        /// No packet is accepted twice, in whatever order packets of many senders arrive.
        #[test]
        fn accepts_no_packet_twice(order in prop::collection::vec((1u32..40, 0u64..90_000_000), 1..300)) {
            let mut verifier = Verifier::new(key());
            let mut recorded = std::vec::Vec::new();
            for &(system, at_us) in &order {
                let (packet, len) = signed(&mut Signer::new(key(), 0), NOW.plus_us(at_us), system);
                let is_old = recorded.contains(&(packet, len));
                let verdict = verifier.check(NOW, &packet[..len]);
                prop_assert!(!(is_old && verdict.is_ok()));
                if verdict.is_ok() {
                    recorded.push((packet, len));
                }
                for (packet, len) in &recorded {
                    prop_assert_eq!(verifier.check(NOW, &packet[..*len]), Err(SigningFault::Replayed));
                }
            }
        }

        #[test]
        fn rejects_any_bytes_without_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Verifier::new(key()).check(NOW, &bytes).is_err());
        }
    }
}
