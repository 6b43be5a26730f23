//! Encodes the bridge's own packets: MAVLink 2 with truncated payloads.

use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{MAX_PACKET, MavlinkVersion, Message};

use crate::packet::x25;

/// Writes a packet of message `id` into `out`. Returns its length. The message must be in the dialect.
pub fn write_packet(
    out: &mut [u8; MAX_PACKET],
    source: (u8, u8),
    sequence: u8,
    id: u32,
    payload: &[u8],
) -> usize {
    // At least one byte stays, even if it is zero (MAVLink guide, "Empty-byte payload truncation").
    let trailing = payload.iter().rev().take_while(|&&byte| byte == 0).count();
    let len = (payload.len() - trailing).max(1);
    let [id0, id1, id2, _] = id.to_le_bytes();
    out[..10]
        .copy_from_slice(&[0xFD, len as u8, 0, 0, sequence, source.0, source.1, id0, id1, id2]);
    out[10..10 + len].fill(0);
    let given = payload.len().min(len);
    out[10..10 + given].copy_from_slice(&payload[..given]);
    write_crc(&mut out[..12 + len], id);
    12 + len
}

/// Writes a message into `out`. Returns its length.
pub(crate) fn write_message(
    out: &mut [u8; MAX_PACKET],
    source: (u8, u8),
    sequence: u8,
    message: &BridgeMessage,
) -> usize {
    let mut payload = [0; 255];
    let len = message.payload(&mut payload);
    write_packet(out, source, sequence, message.id(), &payload[..len])
}

/// Replaces the sequence number of one of the bridge's own unsigned packets.
pub(crate) fn renumber(packet: &mut [u8], sequence: u8) {
    packet[4] = sequence;
    let id = u32::from_le_bytes([packet[7], packet[8], packet[9], 0]);
    write_crc(packet, id);
}

fn write_crc(packet: &mut [u8], id: u32) {
    let at = packet.len() - 2;
    let extra = MavMessage::extra_crc(id);
    let crc = packet[1..at].iter().chain([&extra]).fold(0xFFFF, |crc, &byte| x25(crc, byte));
    packet[at..].copy_from_slice(&crc.to_le_bytes());
}

macro_rules! bridge_messages {
    ($($name:ident($data:ident)),* $(,)?) => {
        /// Messages that the bridge sends. The dialect's own enum would link all of its 300 messages into a chip's
        /// flash.
        #[allow(non_camel_case_types, clippy::upper_case_acronyms)] // Why: MAVLink's names.
        #[derive(Clone, Debug)]
        pub(crate) enum BridgeMessage {
            $($name(vizflyt_protocol::mavlink::dialect::$data)),*
        }

        impl BridgeMessage {
            pub(crate) fn id(&self) -> u32 {
                use vizflyt_protocol::mavlink::MessageData;
                match self {
                    $(Self::$name(_) => vizflyt_protocol::mavlink::dialect::$data::ID),*
                }
            }

            fn payload(&self, out: &mut [u8]) -> usize {
                use vizflyt_protocol::mavlink::MessageData;
                match self {
                    $(Self::$name(data) => data.ser(MavlinkVersion::V2, out)),*
                }
            }
        }
    };
}

bridge_messages!(
    HEARTBEAT(HEARTBEAT_DATA),
    PARAM_VALUE(PARAM_VALUE_DATA),
    RADIO_STATUS(RADIO_STATUS_DATA),
    STATUSTEXT(STATUSTEXT_DATA),
    COMMAND_LONG(COMMAND_LONG_DATA),
    TIMESYNC(TIMESYNC_DATA),
);

#[cfg(test)]
mod tests {
    extern crate std;

    use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, TIMESYNC_DATA};
    use vizflyt_protocol::mavlink::{MavHeader, encode};

    use super::*;

    #[test]
    fn encodes_the_same_bytes_as_the_dialect() {
        let heartbeat = HEARTBEAT_DATA { custom_mode: 7, ..Default::default() };
        let timesync = TIMESYNC_DATA { ts1: 5, ..Default::default() };
        let empty = TIMESYNC_DATA::default();
        for (own, message) in [
            (BridgeMessage::HEARTBEAT(heartbeat.clone()), MavMessage::HEARTBEAT(heartbeat)),
            (BridgeMessage::TIMESYNC(timesync.clone()), MavMessage::TIMESYNC(timesync)),
            (BridgeMessage::TIMESYNC(empty.clone()), MavMessage::TIMESYNC(empty)),
        ] {
            let (mut ours, mut theirs) = ([0; MAX_PACKET], [0; MAX_PACKET]);
            let header = MavHeader { system_id: 1, component_id: 240, sequence: 9 };
            let len = write_message(&mut ours, (1, 240), 3, &own);
            renumber(&mut ours[..len], 9);
            assert_eq!(&ours[..len], encode(header, &message, &mut theirs));
        }
    }
}
