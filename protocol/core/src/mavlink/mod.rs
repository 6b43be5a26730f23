//! Conversions to and from MAVLink (ardupilotmega). The only code with north-east-down and forward-right-down axes,
//! wxyz quaternions and type masks.
//!
//! Messages are those of the `mavlink` crate, re-exported as [`dialect`], so that runtime, simulator and bridge use the
//! same version.

mod command;
mod distance;
mod fence;
mod frames;
mod heartbeat;
mod setpoint;
mod signing;
mod state;
mod stream;

pub use ::mavlink::dialects::ardupilotmega as dialect;
pub use ::mavlink::{MavHeader, MavlinkVersion, Message, MessageData};

pub use crate::copter_mode::CopterMode;
pub use command::{command_name, result_name};
pub use distance::{distance_to_mavlink, obstacles_to_mavlink};
pub use fence::{
    FenceCorner, FenceSide, GlobalPoint, fence_corner_from_mavlink, fence_corner_to_mavlink,
    fence_request_from_mavlink, mission_result_name,
};
pub use frames::{
    body_from_frd, frd_from_body, ned_from_world, ned_rotation_from_world, world_from_ned,
    world_rotation_from_ned, yaw_ned_from_world, yaw_world_from_ned,
};
pub use heartbeat::{HeartbeatSender, heartbeat_sender, heartbeat_sender_name};
pub use setpoint::{
    GuidedMotion, GuidedSetpoint, UnsupportedSetpoint, guided_from_mavlink, guided_to_mavlink,
};
pub use signing::{SIGNATURE, Signer, SigningFault, SigningKey, SigningTime, Verifier, is_signed};
pub use state::{
    attitude_from_mavlink, attitude_to_mavlink, highres_imu_from_mavlink,
    local_position_from_mavlink, local_position_to_mavlink, raw_imu_from_mavlink,
    vision_from_mavlink, vision_of_sample, vision_to_mavlink,
};
pub use stream::{MAX_PACKET, Packet, StreamDecoder, StreamStats, encode};
