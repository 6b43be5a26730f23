//! Positions of the target fields in messages. MAVLink sorts fields by size, so the positions differ by message. The
//! table contains every message of the dialect with a target; all other messages are broadcasts, as MAVLink's routing
//! rules require.

/// Returns the position of the target system in the payload of message `id`, and whether the target component follows
/// it. Returns `None` if the message has no target.
pub(crate) fn offset(id: u32) -> Option<(u8, bool)> {
    let id = u16::try_from(id).ok()?;
    let row = TARGETS.binary_search_by_key(&id, |&(id, _, _)| id).ok()?;
    let (_, at, has_component) = TARGETS[row];
    Some((at, has_component))
}

/// (message, position of the target system [bytes], whether the target component follows).
#[rustfmt::skip]
const TARGETS: &[(u16, u8, bool)] = &[
    (4, 12, true), (5, 0, false), (11, 4, false), (20, 2, true), (21, 0, true), (23, 4, true),
    (37, 4, true), (38, 4, true), (39, 32, true), (40, 2, true), (41, 2, true), (43, 0, true),
    (44, 2, true), (45, 0, true), (47, 0, true), (48, 12, false), (50, 18, true), (51, 2, true),
    (54, 24, true), (66, 2, true), (69, 10, false), (70, 16, true), (73, 32, true), (75, 30, true),
    (76, 30, true), (77, 8, true), (80, 2, true), (82, 36, true), (84, 50, true), (86, 50, true),
    (110, 1, true), (111, 16, true), (117, 4, true), (119, 10, true), (121, 0, true),
    (122, 0, true), (123, 0, true), (126, 79, true), (139, 41, true), (151, 6, true),
    (154, 6, true), (155, 4, true), (156, 0, true), (157, 12, true), (158, 12, true),
    (160, 8, true), (161, 0, true), (175, 14, true), (176, 0, true), (179, 26, false),
    (180, 42, false), (183, 0, true), (184, 4, true), (185, 4, true), (186, 0, true),
    (200, 40, true), (201, 12, true), (214, 6, true), (216, 0, true), (218, 0, true),
    (243, 52, false), (248, 3, true), (256, 8, true), (258, 0, true), (266, 2, true),
    (267, 2, true), (268, 2, true), (282, 32, true), (284, 30, true), (285, 38, true),
    (286, 50, true), (287, 20, true), (288, 20, true), (296, 36, true), (320, 2, true),
    (321, 0, true), (323, 0, true), (345, 2, true), (385, 2, true), (386, 4, true), (387, 4, true),
    (388, 32, true), (400, 4, true), (401, 4, true), (412, 4, true), (413, 4, true),
    (11000, 4, true), (11002, 4, true), (11004, 8, true), (11033, 16, true), (11035, 4, true),
    (12900, 0, true), (12901, 30, true), (12902, 4, true), (12903, 0, true), (12904, 28, true),
    (12905, 0, true), (12915, 0, true), (12919, 16, true), (50004, 8, true), (50005, 4, true),
];

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec;

    use vizflyt_protocol::mavlink::dialect::MavMessage;
    use vizflyt_protocol::mavlink::{MavlinkVersion, Message};

    use super::*;

    fn payload(message: &MavMessage) -> [u8; 255] {
        let mut payload = [0; 255];
        message.ser(MavlinkVersion::V2, &mut payload);
        payload
    }

    fn differing(a: &[u8], b: &[u8]) -> Vec<usize> {
        (0..a.len()).filter(|&at| a[at] != b[at]).collect()
    }

    /// Verifies each row: writes a target into the message and finds the changed bytes.
    #[test]
    fn table_matches_the_dialect() {
        for &id in MavMessage::all_ids() {
            let mut message = MavMessage::default_message_from_id(id).unwrap();
            let plain = payload(&message);
            let Some(system) = message.target_system_id_mut() else {
                assert_eq!(offset(id), None, "message {id}");
                continue;
            };
            *system ^= 0x55;
            let addressed = payload(&message);
            let places = differing(&plain, &addressed);
            let has_component = match message.target_component_id_mut() {
                None => false,
                Some(component) => {
                    *component ^= 0x55;
                    let behind = differing(&addressed, &payload(&message));
                    assert_eq!(behind, [places[0] + 1], "message {id}");
                    true
                }
            };
            assert_eq!(places.len(), 1, "message {id}");
            assert_eq!(offset(id), Some((places[0] as u8, has_component)), "message {id}");
        }
        assert_eq!(offset(0x0100_0000 - 1), None);
    }
}
