//! Finds whole MAVLink packets in bytes and reads their headers, not their payloads.
//!
//! Unlike the decoder of `vizflyt_protocol`, this one keeps the bytes of each packet, signature included, so that
//! packets are forwarded unchanged. If a candidate fails its checksum, the search continues at its second byte, so a
//! good packet inside a broken one is not lost. Messages that are not in the dialect also pass: their checksum is
//! tested with every possible CRC_EXTRA, which still rejects 255 of 256 random candidates.

use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{MAX_PACKET, Message};

/// Whole packet with a valid checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Raw<'a> {
    bytes: &'a [u8],
}

impl<'a> Raw<'a> {
    /// Returns all bytes of the packet, signature included.
    pub fn bytes(self) -> &'a [u8] {
        self.bytes
    }

    /// Whether the packet is MAVLink 2.
    pub fn is_v2(self) -> bool {
        self.bytes[0] == STX_V2
    }

    /// Whether a signature follows the checksum.
    pub fn is_signed(self) -> bool {
        self.is_v2() && self.bytes[2] & SIGNED != 0
    }

    /// Returns the bytes that a signature covers: all except the last six.
    pub(crate) fn signed_bytes(self) -> Option<&'a [u8]> {
        self.is_signed().then(|| &self.bytes[..self.bytes.len() - 6])
    }

    /// Returns the signature's time stamp; 0 without a signature [10 us since 2015].
    pub(crate) fn signed_at(self) -> u64 {
        let mut stamp = [0; 8];
        if let Some(signed) = self.signed_bytes() {
            stamp[..6].copy_from_slice(&signed[signed.len() - 6..]);
        }
        u64::from_le_bytes(stamp)
    }

    /// Returns the sender's sequence number.
    pub fn sequence(self) -> u8 {
        self.bytes[if self.is_v2() { 4 } else { 2 }]
    }

    /// Returns the sender (system, component).
    pub fn source(self) -> (u8, u8) {
        let at = if self.is_v2() { 5 } else { 3 };
        (self.bytes[at], self.bytes[at + 1])
    }

    /// Returns the message number.
    pub fn id(self) -> u32 {
        message_id(self.bytes)
    }

    /// Returns the payload. MAVLink 2 truncates zeros at its end.
    pub fn payload(self) -> &'a [u8] {
        let header = header_len(self.bytes[0]);
        &self.bytes[header..header + usize::from(self.bytes[1])]
    }

    /// Returns the target (system, component); zero is a broadcast.
    pub fn target(self) -> (u8, u8) {
        let Some((system_at, has_component)) = crate::message_target::offset(self.id()) else {
            return (0, 0);
        };
        let byte = |at: usize| self.payload().get(at).copied().unwrap_or(0);
        let at = usize::from(system_at);
        (byte(at), if has_component { byte(at + 1) } else { 0 })
    }
}

/// Counters of a cutter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CutStats {
    /// Whole packets.
    pub packets: u32,
    /// Packets of messages that are not in the dialect; included in `packets`.
    pub unknown: u32,
    /// Candidates that failed their checksum.
    pub bad_checksum: u32,
    /// Bytes outside of packets.
    pub dropped_bytes: u32,
}

impl CutStats {
    /// All zero: the default as a `const`.
    pub(crate) const NONE: Self =
        Self { packets: 0, unknown: 0, bad_checksum: 0, dropped_bytes: 0 };
}

/// Splits a stream of bytes into whole packets.
#[derive(Clone, Debug)]
pub struct Cutter {
    buffer: [u8; BUFFER],
    filled: usize,
    stats: CutStats,
}

/// Space for one packet and the rest of a read.
const BUFFER: usize = MAX_PACKET + 128;

impl Default for Cutter {
    fn default() -> Self {
        Self::new()
    }
}

impl Cutter {
    /// Returns an empty cutter.
    pub const fn new() -> Self {
        Self { buffer: [0; BUFFER], filled: 0, stats: CutStats::NONE }
    }

    /// Takes bytes and calls `sink` with each whole packet, in order.
    pub fn push(&mut self, mut bytes: &[u8], mut sink: impl FnMut(Raw<'_>)) {
        while !bytes.is_empty() {
            let taken = bytes.len().min(BUFFER - self.filled);
            self.buffer[self.filled..self.filled + taken].copy_from_slice(&bytes[..taken]);
            self.filled += taken;
            bytes = &bytes[taken..];
            let used = cut(&self.buffer[..self.filled], false, &mut self.stats, &mut sink);
            self.buffer.copy_within(used..self.filled, 0);
            self.filled -= used;
        }
    }

    /// Searches for whole packets behind a false start; call it when the line is silent inside a candidate. A possible
    /// beginning of a packet stays in the buffer for any time, because its checksum decides, not a timeout.
    pub fn look_behind(&mut self, mut sink: impl FnMut(Raw<'_>)) {
        while let Some(at) = hidden(&self.buffer[..self.filled]) {
            self.stats.bad_checksum = self.stats.bad_checksum.wrapping_add(1);
            self.stats.dropped_bytes = self.stats.dropped_bytes.wrapping_add(at as u32);
            let rest = &self.buffer[at..self.filled];
            let used = at + cut(rest, false, &mut self.stats, &mut sink);
            self.buffer.copy_within(used..self.filled, 0);
            self.filled -= used;
        }
    }

    /// Whether an incomplete packet waits for more bytes.
    pub fn is_waiting(&self) -> bool {
        self.filled > 0
    }

    /// Discards an incomplete packet, for a new connection.
    pub fn restart(&mut self) {
        self.filled = 0;
    }

    pub fn stats(&self) -> CutStats {
        self.stats
    }
}

/// Calls `sink` with each whole packet of a datagram. Incomplete packets are dropped: a datagram contains only whole
/// ones.
pub fn each_in_datagram(bytes: &[u8], stats: &mut CutStats, mut sink: impl FnMut(Raw<'_>)) {
    cut(bytes, true, stats, &mut sink);
}

/// Cuts `bytes` into packets. Returns the number of consumed bytes. `ended`: no more bytes will follow.
fn cut(bytes: &[u8], ended: bool, stats: &mut CutStats, sink: &mut impl FnMut(Raw<'_>)) -> usize {
    let mut at = 0;
    while at < bytes.len() {
        let rest = &bytes[at..];
        let Some(skip) = rest.iter().position(|&byte| byte == STX_V1 || byte == STX_V2) else {
            stats.dropped_bytes = stats.dropped_bytes.wrapping_add(rest.len() as u32);
            return bytes.len();
        };
        stats.dropped_bytes = stats.dropped_bytes.wrapping_add(skip as u32);
        at += skip;
        let rest = &bytes[at..];
        match candidate(rest) {
            Candidate::Good { len, known } => {
                stats.packets = stats.packets.wrapping_add(1);
                stats.unknown = stats.unknown.wrapping_add(u32::from(!known));
                sink(Raw { bytes: &rest[..len] });
                at += len;
            }
            Candidate::Incomplete if !ended => return at,
            verdict => {
                let failed = u32::from(matches!(verdict, Candidate::Bad));
                stats.bad_checksum = stats.bad_checksum.wrapping_add(failed);
                stats.dropped_bytes = stats.dropped_bytes.wrapping_add(1);
                at += 1;
            }
        }
    }
    bytes.len()
}

/// Returns the start of a whole, known packet behind the unfinished one at the start of `bytes`. The next packet or the
/// end of the bytes must follow it; otherwise it may be part of a payload.
fn hidden(bytes: &[u8]) -> Option<usize> {
    (1..bytes.len()).find(|&at| match bytes[at] {
        STX_V1 | STX_V2 => match candidate(&bytes[at..]) {
            Candidate::Good { len, known: true } => {
                bytes.get(at + len).is_none_or(|next| matches!(*next, STX_V1 | STX_V2))
            }
            _ => false,
        },
        _ => false,
    })
}

enum Candidate {
    Incomplete,
    Bad,
    Good { len: usize, known: bool },
}

const STX_V1: u8 = 0xFE;
const STX_V2: u8 = 0xFD;
/// MAVLink 2's only incompatibility flag: a signature of 13 bytes follows.
const SIGNED: u8 = 0x01;
const SIGNATURE: usize = 13;

/// Returns the length of a header by its start marker (MAVLink guide, "Packet serialization").
fn header_len(marker: u8) -> usize {
    if marker == STX_V2 { 10 } else { 6 }
}

/// Returns the message number of the header at the start of `bytes`.
fn message_id(bytes: &[u8]) -> u32 {
    if bytes[0] == STX_V2 {
        u32::from_le_bytes([bytes[7], bytes[8], bytes[9], 0])
    } else {
        u32::from(bytes[5])
    }
}

/// Classifies the bytes from a start marker on.
fn candidate(bytes: &[u8]) -> Candidate {
    let &[marker, payload_len, ..] = bytes else { return Candidate::Incomplete };
    let mut signature = 0;
    if marker == STX_V2 {
        let Some(&flags) = bytes.get(2) else { return Candidate::Incomplete };
        if flags & !SIGNED != 0 {
            return Candidate::Bad;
        }
        if flags & SIGNED != 0 {
            signature = SIGNATURE;
        }
    }
    let crc_at = header_len(marker) + usize::from(payload_len);
    let len = crc_at + 2 + signature;
    if bytes.len() < len {
        return Candidate::Incomplete;
    }
    let expected = u16::from_le_bytes([bytes[crc_at], bytes[crc_at + 1]]);
    let body = bytes[1..crc_at].iter().fold(0xFFFF, |crc, &byte| x25(crc, byte));
    // The dialect returns 0 for unknown messages, and for one known message (395).
    let known = match MavMessage::extra_crc(message_id(bytes)) {
        0 => {
            if (0..=255).all(|extra| x25(body, extra) != expected) {
                return Candidate::Bad;
            }
            false
        }
        extra if x25(body, extra) == expected => true,
        _ => return Candidate::Bad,
    };
    Candidate::Good { len, known }
}

/// Returns the checksum `crc` updated with one byte: CRC-16/MCRF4XX as in MAVLink's C code. Without a table, because a
/// chip's constants lie in its scarce RAM.
pub(crate) fn x25(crc: u16, byte: u8) -> u16 {
    let mut t = byte ^ (crc as u8);
    t ^= t << 4;
    let t = u16::from(t);
    (crc >> 8) ^ (t << 8) ^ (t << 3) ^ (t >> 4)
}

#[cfg(test)]
mod tests;
