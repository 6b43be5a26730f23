//! Finds whole MAVLink packets in bytes and reads their headers; never their payload's meaning.
//!
//! Unlike `vizflyt_protocol`'s decoder this one keeps the packet's own bytes, signature and all:
//! what is forwarded is what came. A candidate that fails its checksum is retried from its second
//! byte, so a good packet inside a broken one is never lost. Messages that our dialect does not
//! know pass too: their checksum is held against every possible CRC_EXTRA, which still refuses
//! 255 of 256 pieces of garbage.

use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{MAX_PACKET, Message};

/// One whole packet that checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Raw<'a> {
    bytes: &'a [u8],
}

impl<'a> Raw<'a> {
    /// Returns all its bytes, signature included.
    pub fn bytes(self) -> &'a [u8] {
        self.bytes
    }

    /// Whether it is MAVLink 2.
    pub fn is_v2(self) -> bool {
        self.bytes[0] == STX_V2
    }

    /// Whether a signature follows the checksum.
    pub fn is_signed(self) -> bool {
        self.is_v2() && self.bytes[2] & SIGNED != 0
    }

    /// Returns what a signature is made over: all bytes but the signature's own six.
    pub(crate) fn signed_bytes(self) -> Option<&'a [u8]> {
        self.is_signed().then(|| &self.bytes[..self.bytes.len() - 6])
    }

    /// Returns a signature's stamp; 0 without one. [10 us since 2015]
    pub(crate) fn signed_at(self) -> u64 {
        let mut stamp = [0; 8];
        if let Some(signed) = self.signed_bytes() {
            stamp[..6].copy_from_slice(&signed[signed.len() - 6..]);
        }
        u64::from_le_bytes(stamp)
    }

    /// Returns the sender's packet counter.
    pub fn sequence(self) -> u8 {
        self.bytes[if self.is_v2() { 4 } else { 2 }]
    }

    /// Returns the sender (system, component).
    pub fn source(self) -> (u8, u8) {
        let at = if self.is_v2() { 5 } else { 3 };
        (self.bytes[at], self.bytes[at + 1])
    }

    /// Returns the message's number.
    pub fn id(self) -> u32 {
        message_id(self.bytes)
    }

    /// Returns the payload; MAVLink 2 leaves out zeros at its end.
    pub fn payload(self) -> &'a [u8] {
        let header = header_len(self.bytes[0]);
        &self.bytes[header..header + usize::from(self.bytes[1])]
    }

    /// Returns the target (system, component); zero is everybody.
    pub fn target(self) -> (u8, u8) {
        let Some((system_at, has_component)) = crate::message_target::offset(self.id()) else {
            return (0, 0);
        };
        let byte = |at: usize| self.payload().get(at).copied().unwrap_or(0);
        let at = usize::from(system_at);
        (byte(at), if has_component { byte(at + 1) } else { 0 })
    }
}

/// What a cutter has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CutStats {
    /// Whole packets.
    pub packets: u32,
    /// Packets of messages that our dialect does not know; among `packets`.
    pub unknown: u32,
    /// Candidates that failed their checksum.
    pub bad_checksum: u32,
    /// Bytes that belonged to no packet.
    pub dropped_bytes: u32,
}

impl CutStats {
    /// Nothing yet; as the default, but `const`.
    pub(crate) const NONE: Self =
        Self { packets: 0, unknown: 0, bad_checksum: 0, dropped_bytes: 0 };
}

/// Bytes of a stream in, whole packets out.
#[derive(Clone, Debug)]
pub struct Cutter {
    buffer: [u8; BUFFER],
    filled: usize,
    stats: CutStats,
}

/// Room for one packet and what a read brings behind it.
const BUFFER: usize = MAX_PACKET + 128;

impl Default for Cutter {
    fn default() -> Self {
        Self::new()
    }
}

impl Cutter {
    /// An empty one.
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

    /// The line is silent within what may be a packet. A whole packet behind a false start comes out
    /// now; what may still be a packet's beginning stays, however long the rest takes: its checksum
    /// decides, not the clock.
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

    /// Whether it waits for the rest of a packet.
    pub fn is_waiting(&self) -> bool {
        self.filled > 0
    }

    /// Forgets an unfinished packet: the connection is another one.
    pub fn restart(&mut self) {
        self.filled = 0;
    }

    /// Returns the counters.
    pub fn stats(&self) -> CutStats {
        self.stats
    }
}

/// Calls `sink` with each whole packet of a datagram. Nothing waits: a datagram holds whole packets.
pub fn each_in_datagram(bytes: &[u8], stats: &mut CutStats, mut sink: impl FnMut(Raw<'_>)) {
    cut(bytes, true, stats, &mut sink);
}

/// Cuts `bytes`; returns how many are done with. `ended`: no more will come.
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

/// Returns where a whole packet of the dialect begins behind the unfinished one that `bytes` begin with.
/// What follows it must be the next one's start, or nothing yet: then it is no part of a payload.
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
/// MAVLink 2's one incompatible feature: a signature of 13 bytes follows.
const SIGNED: u8 = 0x01;
const SIGNATURE: usize = 13;

/// Returns the length of a header by its start marker (MAVLink guide, "Packet serialization").
fn header_len(marker: u8) -> usize {
    if marker == STX_V2 { 10 } else { 6 }
}

/// Returns the number of the message whose header begins `bytes`.
fn message_id(bytes: &[u8]) -> u32 {
    if bytes[0] == STX_V2 {
        u32::from_le_bytes([bytes[7], bytes[8], bytes[9], 0])
    } else {
        u32::from(bytes[5])
    }
}

/// Judges the bytes from a start marker on.
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
    // The dialect answers 0 for what it does not know, and for one message that it does (395).
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

/// Returns the checksum with one byte more: CRC-16/MCRF4XX as MAVLink's C code has it. No table,
/// because a chip's constants lie in its scarce RAM.
pub(crate) fn x25(crc: u16, byte: u8) -> u16 {
    let mut t = byte ^ (crc as u8);
    t ^= t << 4;
    let t = u16::from(t);
    (crc >> 8) ^ (t << 8) ^ (t << 3) ^ (t >> 4)
}

#[cfg(test)]
mod tests;
