//! Splits a byte stream (serial, UDP, TCP) into MAVLink packets and counts losses.
//!
//! If a candidate fails its checksum, the search continues at its second byte, so that a good packet inside a broken
//! one is not lost. Accepts MAVLink 1 and 2. Unknown messages are counted, but are not errors.

use ::mavlink::{MAVLinkV2MessageRaw, MavHeader, MavlinkVersion, Message, calculate_crc};

use super::dialect::MavMessage;

/// Maximum packet size: MAVLink 2, full payload, signed. [bytes]
pub const MAX_PACKET: usize = 280;

/// One decoded packet.
#[derive(Clone, Debug, PartialEq)]
pub struct Packet {
    /// Sender and sequence number.
    pub header: MavHeader,
    /// The message.
    pub message: MavMessage,
}

/// Counters of a decoder since its creation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamStats {
    /// Packets decoded.
    pub packets: u64,
    /// Valid packets of an unknown message or with an invalid value.
    pub unknown: u64,
    /// Bytes outside valid packets.
    pub dropped_bytes: u64,
}

/// Decoder from bytes to packets.
#[derive(Clone)]
pub struct StreamDecoder {
    buffer: [u8; 2 * MAX_PACKET],
    filled: usize,
    stats: StreamStats,
}

impl Default for StreamDecoder {
    fn default() -> Self {
        Self { buffer: [0; 2 * MAX_PACKET], filled: 0, stats: StreamStats::default() }
    }
}

impl StreamDecoder {
    /// Adds bytes and calls `sink` for each complete packet, in order.
    pub fn push(&mut self, bytes: &[u8], mut sink: impl FnMut(Packet)) {
        self.push_whole(bytes, |_, packet| sink(packet));
    }

    /// Like [`Self::push`], but also passes the packet's bytes to `sink`, for example to verify a signature.
    pub fn push_whole(&mut self, mut bytes: &[u8], mut sink: impl FnMut(&[u8], Packet)) {
        while !bytes.is_empty() {
            let taken = bytes.len().min(self.buffer.len() - self.filled);
            self.buffer[self.filled..self.filled + taken].copy_from_slice(&bytes[..taken]);
            self.filled += taken;
            bytes = &bytes[taken..];
            self.drain(&mut sink);
        }
    }

    /// Returns the counters.
    pub fn stats(&self) -> StreamStats {
        self.stats
    }

    /// Removes all complete packets from the buffer. Leaves less than one packet.
    fn drain(&mut self, sink: &mut impl FnMut(&[u8], Packet)) {
        let mut start = 0;
        loop {
            let pending = &self.buffer[start..self.filled];
            let Some(skip) = pending.iter().position(|&b| b == STX_V1 || b == STX_V2) else {
                self.stats.dropped_bytes += pending.len() as u64;
                start = self.filled;
                break;
            };
            self.stats.dropped_bytes += skip as u64;
            start += skip;
            match candidate(&self.buffer[start..self.filled]) {
                Candidate::Incomplete => break,
                Candidate::Bad => {
                    self.stats.dropped_bytes += 1;
                    start += 1;
                }
                Candidate::Good { len, packet } => {
                    match packet {
                        Some(packet) => {
                            self.stats.packets += 1;
                            sink(&self.buffer[start..start + len], packet);
                        }
                        None => self.stats.unknown += 1,
                    }
                    start += len;
                }
            }
        }
        self.buffer.copy_within(start..self.filled, 0);
        self.filled -= start;
    }
}

const STX_V1: u8 = 0xFE;
pub(super) const STX_V2: u8 = 0xFD;
const SIGNED: u8 = 0x01;

#[allow(clippy::large_enum_variant)] // Why: short-lived, and there is no heap to box it on.
enum Candidate {
    Incomplete,
    Bad,
    Good { len: usize, packet: Option<Packet> },
}

/// Checks the bytes from a start marker on.
fn candidate(bytes: &[u8]) -> Candidate {
    // (header, checksum end) sizes by version: MAVLink guide, "Packet serialization".
    let (version, header_len, flags_ok, signature) = match bytes {
        [STX_V1, ..] => (MavlinkVersion::V1, 6, true, 0),
        [STX_V2, _, flags, ..] => {
            let signature = if flags & SIGNED != 0 { 13 } else { 0 };
            (MavlinkVersion::V2, 10, flags & !SIGNED == 0, signature)
        }
        _ => return Candidate::Incomplete,
    };
    let Some(&payload_len) = bytes.get(1) else { return Candidate::Incomplete };
    if !flags_ok {
        return Candidate::Bad;
    }
    let crc_at = header_len + usize::from(payload_len);
    let len = crc_at + 2 + signature;
    if bytes.len() < len {
        return Candidate::Incomplete;
    }
    let id = match version {
        MavlinkVersion::V1 => u32::from(bytes[5]),
        MavlinkVersion::V2 => u32::from_le_bytes([bytes[7], bytes[8], bytes[9], 0]),
    };
    let crc = u16::from_le_bytes([bytes[crc_at], bytes[crc_at + 1]]);
    if calculate_crc(&bytes[1..crc_at], MavMessage::extra_crc(id)) != crc {
        return Candidate::Bad;
    }
    let (sequence, system_id, component_id) = match version {
        MavlinkVersion::V1 => (bytes[2], bytes[3], bytes[4]),
        MavlinkVersion::V2 => (bytes[4], bytes[5], bytes[6]),
    };
    let payload = &bytes[header_len..crc_at];
    let packet = MavMessage::parse(version, id, payload).ok().map(|message| Packet {
        header: MavHeader { system_id: system_id.into(), component_id, sequence },
        message,
    });
    Candidate::Good { len, packet }
}

/// Encodes a message as MAVLink 2 into `buffer`; returns the bytes to send.
pub fn encode<'a>(
    header: MavHeader,
    message: &MavMessage,
    buffer: &'a mut [u8; MAX_PACKET],
) -> &'a [u8] {
    let mut raw = MAVLinkV2MessageRaw::new();
    raw.serialize_message(header, message);
    let bytes = raw.raw_bytes();
    buffer[..bytes.len()].copy_from_slice(bytes);
    &buffer[..bytes.len()]
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::dialect::{HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, TIMESYNC_DATA};
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn header(sequence: u8) -> MavHeader {
        MavHeader { system_id: 1, component_id: 1, sequence }
    }

    fn stream() -> (Vec<u8>, Vec<MavMessage>) {
        let messages = std::vec![
            MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()),
            // Bytes inside a payload that look like a start marker.
            MavMessage::TIMESYNC(TIMESYNC_DATA {
                tc1: i64::from_le_bytes([0xFD; 8]),
                ts1: i64::from_le_bytes([0xFE; 8]),
                ..Default::default()
            }),
            MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                x: 1.5,
                ..Default::default()
            }),
        ];
        let mut bytes = Vec::new();
        for (sequence, message) in messages.iter().enumerate() {
            bytes.extend_from_slice(encode(header(sequence as u8), message, &mut [0; MAX_PACKET]));
        }
        (bytes, messages)
    }

    fn decode(bytes: &[u8], chunk: usize) -> (Vec<MavMessage>, StreamStats) {
        let (mut decoder, mut found) = (StreamDecoder::default(), Vec::new());
        for part in bytes.chunks(chunk) {
            decoder.push(part, |packet| found.push(packet.message));
        }
        (found, decoder.stats())
    }

    #[test]
    fn decodes_a_stream_at_every_chunk_size() {
        let (bytes, messages) = stream();
        for chunk in 1..=bytes.len() {
            let (found, stats) = decode(&bytes, chunk);
            assert_eq!(found, messages, "chunk size {chunk}");
            assert_eq!(stats.dropped_bytes, 0);
        }
    }

    #[test]
    fn finds_a_packet_inside_a_broken_one() {
        let (good, messages) = stream();
        // A header that announces 200 bytes of payload, followed by a complete good stream.
        let mut bytes = std::vec![0xFD, 200, 0, 0, 0, 1, 1, 0, 0, 0];
        bytes.extend_from_slice(&good);
        bytes.extend_from_slice(&[0; 300]);
        for chunk in [1, 7, bytes.len()] {
            assert_eq!(decode(&bytes, chunk).0, messages);
        }
    }

    #[test]
    fn encoder_matches_the_mavlink_crate() {
        for message in stream().1 {
            let mut theirs = Vec::new();
            ::mavlink::write_v2_msg(&mut theirs, header(9), &message).unwrap();
            assert_eq!(encode(header(9), &message, &mut [0; MAX_PACKET]), theirs);
        }
    }

    proptest! {
        #[test]
        fn garbage_does_not_affect_later_packets(garbage in prop::collection::vec(any::<u8>(), 0..300), chunk in 1..64usize) {
            let (good, messages) = stream();
            let mut bytes = garbage;
            bytes.extend_from_slice(&good);
            // Complete a candidate that starts in the garbage and waits for more bytes.
            bytes.extend_from_slice(&[0; MAX_PACKET]);
            let (found, _) = decode(&bytes, chunk);
            prop_assert!(found.ends_with(&messages));
        }
    }
}
