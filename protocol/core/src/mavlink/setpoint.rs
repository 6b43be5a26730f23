//! Guarded setpoints to and from SET_POSITION_TARGET_LOCAL_NED (message 84), as interpreted by ArduCopter's GUIDED
//! mode: a group of three axes is used only if it is complete. Yaw is always sent, because with an ignored yaw the
//! vehicle turns into the direction of travel.

use glam::DVec3;

use super::dialect::{MavFrame, PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA};
use super::frames::{ned_from_world, world_from_ned, yaw_ned_from_world, yaw_world_from_ned};
use crate::messages::YawTarget;

/// Motion in world axes, after the guard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GuidedMotion {
    /// Fly to a point. [m, world]
    Position(DVec3),
    /// Fly at a velocity. [m/s, world]
    Velocity(DVec3),
    /// Follow a moving point: position [m, world] with velocity feed-forward [m/s, world].
    PositionVelocity(DVec3, DVec3),
    /// Accelerate; gravity is compensated. [m/s^2, world]
    Acceleration(DVec3),
}

/// Setpoint for the autopilot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GuidedSetpoint {
    /// Requested motion.
    pub motion: GuidedMotion,
    /// Heading. Never [`YawTarget::Keep`] on the wire: the guard converts it to an angle.
    pub yaw: YawTarget,
}

const IGNORE_POSITION: u16 = 0x007;
const IGNORE_VELOCITY: u16 = 0x038;
const IGNORE_ACCELERATION: u16 = 0x1C0;
const IGNORE_YAW: u16 = 0x400;
const IGNORE_YAW_RATE: u16 = 0x800;

/// Returns the message for `target` (system, component).
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint, guided_to_mavlink};
/// use vizflyt_protocol::messages::YawTarget;
/// // 2 m/s east and 0.5 m/s up, nose east.
/// let setpoint = GuidedSetpoint {
///     motion: GuidedMotion::Velocity(DVec3::new(2.0, 0.0, 0.5)),
///     yaw: YawTarget::Angle(0.0),
/// };
/// let message = guided_to_mavlink(&setpoint, (1, 1), 1234);
/// assert_eq!((message.vx, message.vy, message.vz), (0.0, 2.0, -0.5));
/// assert_eq!(message.yaw, 90f32.to_radians());
/// assert_eq!(message.type_mask.bits(), 0x9C7);
/// ```
pub fn guided_to_mavlink(
    setpoint: &GuidedSetpoint,
    target: (u8, u8),
    time_boot_ms: u32,
) -> SET_POSITION_TARGET_LOCAL_NED_DATA {
    let mut mask = IGNORE_POSITION | IGNORE_VELOCITY | IGNORE_ACCELERATION;
    let (mut p, mut v, mut a) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO);
    match setpoint.motion {
        GuidedMotion::Position(p_world) => {
            mask &= !IGNORE_POSITION;
            p = ned_from_world(p_world);
        }
        GuidedMotion::Velocity(v_world) => {
            mask &= !IGNORE_VELOCITY;
            v = ned_from_world(v_world);
        }
        GuidedMotion::PositionVelocity(p_world, v_world) => {
            mask &= !(IGNORE_POSITION | IGNORE_VELOCITY);
            p = ned_from_world(p_world);
            v = ned_from_world(v_world);
        }
        GuidedMotion::Acceleration(a_world) => {
            mask &= !IGNORE_ACCELERATION;
            a = ned_from_world(a_world);
        }
    }
    let (mut yaw, mut yaw_rate) = (0.0, 0.0);
    match setpoint.yaw {
        YawTarget::Angle(yaw_world) => {
            mask |= IGNORE_YAW_RATE;
            yaw = yaw_ned_from_world(yaw_world);
        }
        // World yaw is counter-clockwise seen from above, NED yaw clockwise.
        YawTarget::Rate(rate_world) => {
            mask |= IGNORE_YAW;
            yaw_rate = -rate_world;
        }
        YawTarget::Keep => mask |= IGNORE_YAW | IGNORE_YAW_RATE,
    }
    SET_POSITION_TARGET_LOCAL_NED_DATA {
        time_boot_ms,
        x: p.x as f32,
        y: p.y as f32,
        z: p.z as f32,
        vx: v.x as f32,
        vy: v.y as f32,
        vz: v.z as f32,
        afx: a.x as f32,
        afy: a.y as f32,
        afz: a.z as f32,
        yaw: yaw as f32,
        yaw_rate: yaw_rate as f32,
        type_mask: PositionTargetTypemask::from_bits_retain(mask),
        target_system: target.0,
        target_component: target.1,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
    }
}

/// Reason why ArduCopter would ignore the message.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum UnsupportedSetpoint {
    /// The frame is not LOCAL_NED.
    #[error("coordinate frame is not LOCAL_NED")]
    Frame,
    /// The mask leaves no complete group, or a combination without a mode in GUIDED.
    #[error("type mask {0:#05x} has no motion that GUIDED supports")]
    Mask(u16),
    /// A number is not finite.
    #[error("a target is not a finite number")]
    NotFinite,
}

/// Reads the message as ArduCopter does: one ignored axis drops its whole group.
pub fn guided_from_mavlink(
    message: &SET_POSITION_TARGET_LOCAL_NED_DATA,
) -> Result<GuidedSetpoint, UnsupportedSetpoint> {
    if message.coordinate_frame != MavFrame::MAV_FRAME_LOCAL_NED {
        return Err(UnsupportedSetpoint::Frame);
    }
    let mask = message.type_mask.bits();
    let vector = |x: f32, y: f32, z: f32| world_from_ned(DVec3::new(x.into(), y.into(), z.into()));
    let whole = |group: u16| mask & group == 0;
    let p = vector(message.x, message.y, message.z);
    let v = vector(message.vx, message.vy, message.vz);
    let a = vector(message.afx, message.afy, message.afz);
    let motion = match (whole(IGNORE_POSITION), whole(IGNORE_VELOCITY), whole(IGNORE_ACCELERATION))
    {
        (true, true, _) => GuidedMotion::PositionVelocity(p, v),
        (true, false, false) => GuidedMotion::Position(p),
        (false, true, _) => GuidedMotion::Velocity(v),
        (false, false, true) => GuidedMotion::Acceleration(a),
        _ => return Err(UnsupportedSetpoint::Mask(mask)),
    };
    let yaw = if whole(IGNORE_YAW) {
        YawTarget::Angle(yaw_world_from_ned(message.yaw.into()))
    } else if whole(IGNORE_YAW_RATE) {
        YawTarget::Rate(-f64::from(message.yaw_rate))
    } else {
        YawTarget::Keep
    };
    let yaw_finite = match yaw {
        YawTarget::Keep => true,
        YawTarget::Angle(value) | YawTarget::Rate(value) => value.is_finite(),
    };
    let motion_finite = match motion {
        GuidedMotion::Position(u) | GuidedMotion::Velocity(u) | GuidedMotion::Acceleration(u) => {
            u.is_finite()
        }
        GuidedMotion::PositionVelocity(u, w) => u.is_finite() && w.is_finite(),
    };
    if yaw_finite && motion_finite {
        Ok(GuidedSetpoint { motion, yaw })
    } else {
        Err(UnsupportedSetpoint::NotFinite)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn check_mask(motion: GuidedMotion, yaw: YawTarget, expected: u16) {
        let message = guided_to_mavlink(&GuidedSetpoint { motion, yaw }, (1, 1), 0);
        assert_eq!(message.type_mask.bits(), expected);
    }

    /// Masks that a real ArduCopter accepted.
    #[test]
    fn uses_masks_that_arducopter_accepts() {
        let z = DVec3::ZERO;
        check_mask(GuidedMotion::Position(z), YawTarget::Keep, 0xDF8);
        check_mask(GuidedMotion::Position(z), YawTarget::Angle(0.0), 0x9F8);
        check_mask(GuidedMotion::Velocity(z), YawTarget::Angle(0.0), 0x9C7);
        check_mask(GuidedMotion::Velocity(z), YawTarget::Rate(0.0), 0x5C7);
        check_mask(GuidedMotion::PositionVelocity(z, z), YawTarget::Angle(0.0), 0x9C0);
    }

    #[test]
    fn one_ignored_axis_drops_the_group() {
        let velocity = GuidedSetpoint {
            motion: GuidedMotion::Velocity(DVec3::ONE),
            yaw: YawTarget::Angle(0.0),
        };
        let mut message = guided_to_mavlink(&velocity, (1, 1), 0);
        message.type_mask = PositionTargetTypemask::from_bits_retain(0x9C7 | 0x08);
        assert_eq!(guided_from_mavlink(&message), Err(UnsupportedSetpoint::Mask(0x9CF)));
        message.vx = f32::NAN;
        message.type_mask = PositionTargetTypemask::from_bits_retain(0x9C7);
        assert_eq!(guided_from_mavlink(&message), Err(UnsupportedSetpoint::NotFinite));
    }

    fn vector() -> impl Strategy<Value = DVec3> {
        // Values that f32 represents exactly.
        prop::array::uniform3(-1000i16..1000).prop_map(|v| DVec3::from(v.map(|v| v as f64 / 16.0)))
    }

    proptest! {
        #[test]
        fn setpoints_survive_the_wire(p in vector(), v in vector(), kind in 0..4, angle in -3.0..3.0f64, turn in any::<bool>()) {
            let motion = match kind {
                0 => GuidedMotion::Position(p),
                1 => GuidedMotion::Velocity(v),
                2 => GuidedMotion::PositionVelocity(p, v),
                _ => GuidedMotion::Acceleration(v),
            };
            let yaw = if turn { YawTarget::Rate(angle) } else { YawTarget::Angle(angle) };
            let found = guided_from_mavlink(&guided_to_mavlink(&GuidedSetpoint { motion, yaw }, (1, 1), 0)).unwrap();
            prop_assert_eq!(found.motion, motion);
            match found.yaw {
                YawTarget::Angle(found) if !turn => prop_assert!((found - angle).abs() < 1e-6),
                YawTarget::Rate(found) if turn => prop_assert!((found - angle).abs() < 1e-6),
                other => prop_assert!(false, "{:?}", other),
            }
        }
    }
}
