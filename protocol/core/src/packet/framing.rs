//! Framing of messages on an ordered byte stream: a little-endian `u16` length, followed by that number of postcard
//! bytes.

use serde::Serialize;
use serde::de::DeserializeOwned;

/// Maximum size of an encoded message, including the length prefix. [bytes]
pub const MAX_FRAMED: usize = 4096;
const PREFIX: usize = 2;

/// Reason why bytes are not a valid message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FramingError {
    /// The length exceeds [`MAX_FRAMED`]. The rest of the stream cannot be decoded.
    #[error("message of {0} bytes exceeds the limit of 4094; the peer is faulty or hostile")]
    TooLong(usize),
    /// The body is not a message of the expected type. The next message can still be decoded.
    #[error("message body of {0} bytes does not decode; the peer is faulty or of another version")]
    Body(usize),
}

/// Encodes `message` with its length prefix into `buffer`. Returns the bytes to send.
///
/// # Panics
/// Never: every message type of this crate is smaller than [`MAX_FRAMED`] (tested).
pub fn encode<'a, M: Serialize>(message: &M, buffer: &'a mut [u8; MAX_FRAMED]) -> &'a [u8] {
    let body = postcard::to_slice(message, &mut buffer[PREFIX..])
        .expect("message types are bounded below MAX_FRAMED")
        .len();
    buffer[..PREFIX].copy_from_slice(&(body as u16).to_le_bytes());
    &buffer[..PREFIX + body]
}

/// Encodes `message` without a prefix, for transports that preserve message boundaries (shared memory).
///
/// # Panics
/// Never, see [`encode`].
pub fn encode_body<'a, M: Serialize>(message: &M, buffer: &'a mut [u8; MAX_FRAMED]) -> &'a [u8] {
    postcard::to_slice(message, buffer).expect("message types are bounded below MAX_FRAMED")
}

/// Decodes the body of a complete message.
pub fn decode_body<M: DeserializeOwned>(body: &[u8]) -> Result<M, FramingError> {
    postcard::from_bytes(body).map_err(|_| FramingError::Body(body.len()))
}

/// Splits a byte stream into messages.
///
/// Add bytes with [`Self::push`], take messages with [`Self::next`] until it returns `None`, and repeat.
#[derive(Clone)]
pub struct Deframer {
    buffer: [u8; MAX_FRAMED],
    filled: usize,
}

impl Default for Deframer {
    fn default() -> Self {
        Self { buffer: [0; MAX_FRAMED], filled: 0 }
    }
}

impl Deframer {
    /// Adds as many of `bytes` as fit. Returns their number, which is at least one after [`Self::next`] has returned
    /// `None`.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        let taken = bytes.len().min(MAX_FRAMED - self.filled);
        self.buffer[self.filled..self.filled + taken].copy_from_slice(&bytes[..taken]);
        self.filled += taken;
        taken
    }

    /// Returns the next complete message, an error, or `None` if more bytes are needed.
    #[allow(clippy::should_implement_trait)] // Why: the item type is chosen per call.
    pub fn next<M: DeserializeOwned>(&mut self) -> Option<Result<M, FramingError>> {
        let prefix = self.buffer[..self.filled].first_chunk::<PREFIX>()?;
        let body = usize::from(u16::from_le_bytes(*prefix));
        if PREFIX + body > MAX_FRAMED {
            return Some(Err(FramingError::TooLong(body)));
        }
        if self.filled < PREFIX + body {
            return None;
        }
        let message = decode_body(&self.buffer[PREFIX..PREFIX + body]);
        self.buffer.copy_within(PREFIX + body..self.filled, 0);
        self.filled -= PREFIX + body;
        Some(message)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use crate::geometry::{Intrinsics, Pose, Twist, Volume, body_from_forward_cam};
    use crate::messages::*;
    use crate::sensor::{MAX_SENSORS, SensorInfo, SensorKind};
    use crate::time::{HostTime, ServerTime};
    use glam::{DQuat, DVec3, Vec3};
    use std::vec::Vec;

    fn widest_arena() -> ArenaInfo {
        let camera = CameraInfo {
            name: bounded("this camera's name is far too long to fit"),
            intrinsics: Intrinsics::from_horizontal_fov(8192, 8192, 1.2),
            body_from_cam: body_from_forward_cam(DVec3::splat(0.1), 0.3),
        };
        let volume = Volume::Cuboid {
            center_m: DVec3::splat(1.1),
            half_m: DVec3::splat(2.2),
            rotation: DQuat::from_rotation_x(0.4),
        };
        ArenaInfo {
            name: bounded(&"x".repeat(99)),
            geofence: volume,
            no_fly: core::iter::repeat_n(volume, MAX_NO_FLY).collect(),
            floor_z_m: 0.7,
            limits: Limits {
                max_tilt_deg: Some(30.0),
                max_altitude_m: Some(3.3),
                ..Limits::new(5.5, 6.6)
            },
            body_radius_m: 0.12,
            takeoff_height_m: 1.3,
            goal_m: Some(DVec3::splat(9.9)),
            goal_radius_m: 1.0,
            time_limit_s: 99.0,
            start_box: Some(volume),
            ground_truth: true,
            pose_ages: PoseAges::default(),
            setpoints: crate::messages::SetpointKinds::ALL,
            cameras: core::iter::repeat_n(camera, MAX_CAMERAS).collect(),
            sensors: core::iter::repeat_n(widest_sensor(), MAX_SENSORS).collect(),
        }
    }

    fn widest_sensor() -> SensorInfo {
        SensorInfo {
            name: bounded("this sensor's name is far too long to fit"),
            kind: SensorKind::Lidar,
            enabled: true,
            to_autopilot: true,
            rate_hz: 9.9,
            min_range_m: 0.1,
            max_range_m: 99.9,
            horizontal_fov_rad: 6.0,
            vertical_fov_rad: 0.7,
            most_records: u32::MAX,
            body_from_sensor: Pose::new(DVec3::splat(0.1), DQuat::from_rotation_x(0.4)),
        }
    }

    fn welcome() -> Welcome {
        let received_events = ReceivedEvents { boot: u64::MAX, seq: u64::MAX };
        Welcome { boot: u64::MAX, received_events, arena: widest_arena(), feed_port: u16::MAX }
    }

    fn messages() -> Vec<ToRuntime> {
        std::vec![
            ToRuntime::Welcome(welcome()),
            ToRuntime::Refused(bounded(&"why ".repeat(99))),
            ToRuntime::Clock(ClockReply {
                sent: HostTime::from_ns(u64::MAX),
                answered: ServerTime::from_ns(1),
            }),
            ToRuntime::EventsReceived(u64::MAX),
            ToRuntime::Event {
                seq: u64::MAX,
                event: Event {
                    stamp: ServerTime::from_ns(8),
                    kind: EventKind::TimeLimit { limit_s: 20.0 },
                    text: bounded("collision"),
                },
            },
        ]
    }

    #[test]
    fn decodes_a_stream_at_every_chunk_size() {
        let mut stream = Vec::new();
        for message in messages() {
            stream.extend_from_slice(encode(&message, &mut [0; MAX_FRAMED]));
        }
        for chunk in 1..=stream.len() {
            let (mut deframer, mut found) = (Deframer::default(), Vec::new());
            for mut bytes in stream.chunks(chunk) {
                while !bytes.is_empty() {
                    bytes = &bytes[deframer.push(bytes)..];
                    while let Some(message) = deframer.next::<ToRuntime>() {
                        found.push(message.unwrap());
                    }
                }
            }
            assert_eq!(found, messages(), "chunk size {chunk}");
        }
    }

    #[test]
    fn reads_the_next_message_after_an_invalid_body() {
        let mut deframer = Deframer::default();
        deframer.push(&[3, 0, 0xff, 0xff, 0xff]);
        deframer.push(encode(&messages()[1], &mut [0; MAX_FRAMED]));
        assert_eq!(deframer.next::<ToRuntime>(), Some(Err(FramingError::Body(3))));
        assert_eq!(deframer.next::<ToRuntime>(), Some(Ok(messages().remove(1))));
        assert_eq!(deframer.next::<ToRuntime>(), None);
    }

    #[test]
    fn rejects_a_length_above_the_maximum() {
        let mut deframer = Deframer::default();
        deframer.push(&[0xff, 0xff]);
        assert_eq!(deframer.next::<ToRuntime>(), Some(Err(FramingError::TooLong(0xffff))));
    }

    #[test]
    fn the_largest_messages_fit() {
        let mut buffer = [0; MAX_FRAMED];
        assert!(encode(&ToRuntime::Welcome(welcome()), &mut buffer).len() < MAX_FRAMED * 3 / 4);
        assert!(
            encode_body(&ToPlugin::Start(widest_arena()), &mut buffer).len() < MAX_FRAMED * 3 / 4
        );
        let piece = Piece { seconds: 1.1, coefficients: [DVec3::splat(1.1); COEFFICIENTS] };
        let way = Waypoint { p_m: DVec3::splat(1.1), speed_mps: 1.1 };
        let paths = [
            Path::Polynomial(core::iter::repeat_n(piece, MAX_PIECES).collect()),
            Path::Waypoints(core::iter::repeat_n(way, MAX_WAYPOINTS).collect()),
        ];
        for path in paths {
            let trajectory = Trajectory {
                id: u32::MAX,
                axes: Axes::Body,
                path,
                yaw: PathYaw::Target(YawTarget::Angle(1.1)),
            };
            let message = FromPlugin::Reply {
                seq: u64::MAX,
                entered: HostTime::from_ns(u64::MAX),
                returned: HostTime::from_ns(u64::MAX),
                setpoint: Some(Setpoint::Trajectory(trajectory)),
            };
            assert!(encode_body(&message, &mut buffer).len() < MAX_FRAMED / 2);
            assert_eq!(decode_body(encode_body(&message, &mut buffer)), Ok(message));
        }
        let telemetry = ToServer::Telemetry(Telemetry::default());
        assert!(encode(&telemetry, &mut buffer).len() < 1024);
        let times = StageTimes { p50: 1e9, p90: 1e9, p99: 1e9, max: 1e9 };
        let most = u64::MAX;
        let arrivals = Arrivals {
            arrived: most,
            delivered: most,
            stale: most,
            broken: most,
            superseded: most,
            unasked: most,
            overrun: most,
        };
        let timing = Timing {
            seconds: 1e9,
            waterfall: Waterfall {
                images: most,
                answered: most,
                stages: Stages::from_fn(|_| times),
                age: times,
                total: times,
                clamped: most,
                out_of_bound: most,
            },
            intervals: Intervals { times, bins: [u32::MAX; 20] },
            clock: Some(ClockState { offset_ns: i64::MIN, ..ClockState::default() }),
            cameras: core::iter::repeat_n(arrivals, MAX_CAMERAS).collect(),
        };
        let message = ToServer::Timing(timing);
        assert!(encode(&message, &mut buffer).len() < 1536);
        assert_eq!(decode_body(encode_body(&message, &mut buffer)), Ok(message));
        let pose = PoseSample {
            stamp: ServerTime::from_ns(u64::MAX),
            world_from_body: Pose::new(DVec3::splat(1.1), DQuat::from_rotation_x(0.4)),
            twist: Twist { linear_mps: DVec3::splat(2.2), angular_radps: DVec3::splat(3.3) },
            resets: 3,
            position_sigma_m: Vec3::splat(4.4),
            rotation_sigma_rad: Vec3::splat(5.5),
            allowance_s: 0.2,
        };
        // Far smaller than the minimum QUIC packet, 1200 bytes.
        let datagram = encode_body(&Datagram::Pose(pose), &mut buffer);
        assert!(datagram.len() < 200);
        assert_eq!(decode_body(datagram), Ok(Datagram::Pose(pose)));
    }
}
