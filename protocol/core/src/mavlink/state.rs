//! Poses, attitudes and IMU samples to and from MAVLink: VISION_POSITION_ESTIMATE (102),
//! ATTITUDE (30), LOCAL_POSITION_NED (32), RAW_IMU (27), HIGHRES_IMU (105).

use glam::{DQuat, DVec3, EulerRot};

use super::dialect::{
    ATTITUDE_DATA, HIGHRES_IMU_DATA, LOCAL_POSITION_NED_DATA, RAW_IMU_DATA,
    VISION_POSITION_ESTIMATE_DATA,
};
use super::frames::{
    body_from_frd, frd_from_body, ned_from_world, ned_rotation_from_world, world_from_ned,
    world_rotation_from_ned,
};
use crate::geometry::{Body, Pose, World};
use crate::messages::PoseSample;
use crate::time::HostTime;

/// Returns the Euler angles (roll, pitch, yaw) of an attitude, FRD in NED. [rad]
fn euler_ned(world_from_body: DQuat) -> (f64, f64, f64) {
    let (yaw, pitch, roll) = ned_rotation_from_world(world_from_body).to_euler(EulerRot::ZYX);
    (roll, pitch, yaw)
}

/// Returns the attitude of Euler angles (roll, pitch, yaw), FRD in NED. [rad]
fn attitude_of_euler(roll: f32, pitch: f32, yaw: f32) -> DQuat {
    world_rotation_from_ned(DQuat::from_euler(EulerRot::ZYX, yaw.into(), pitch.into(), roll.into()))
}

/// Returns the external navigation message for a localized pose, with standard deviations of position [m, world] and
/// attitude [rad, body].
///
/// ```
/// use glam::{DQuat, DVec3};
/// use vizflyt_protocol::geometry::Pose;
/// use vizflyt_protocol::mavlink::{vision_from_mavlink, vision_to_mavlink};
/// // At (1, 2, 3), level, facing east: NED (2, 1, -3), yaw 90 degrees.
/// let sigma_m = DVec3::new(0.1, 0.2, 0.3);
/// let pose = Pose::new(DVec3::new(1.0, 2.0, 3.0), DQuat::IDENTITY);
/// let message = vision_to_mavlink(&pose, 55, 0, sigma_m, DVec3::splat(0.01));
/// assert_eq!((message.x, message.y, message.z), (2.0, 1.0, -3.0));
/// // The variances of x (north) and y (east).
/// assert!((message.covariance[0] - 0.04).abs() < 1e-6 && (message.covariance[6] - 0.01).abs() < 1e-6);
/// assert!((message.yaw - 90f32.to_radians()).abs() < 1e-6);
/// let back = vision_from_mavlink(&message);
/// assert!((back.translation_m - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-6);
/// ```
pub fn vision_to_mavlink(
    world_from_body: &Pose<World, Body>,
    usec: u64,
    reset_counter: u8,
    position_sigma_m: DVec3,
    rotation_sigma_rad: DVec3,
) -> VISION_POSITION_ESTIMATE_DATA {
    let p = ned_from_world(world_from_body.translation_m);
    let (roll, pitch, yaw) = euler_ned(world_from_body.rotation);
    let mut covariance = [0.0; 21];
    // Upper triangle, row by row: the diagonal of (x, y, z, roll, pitch, yaw). For a nearly level vehicle, errors of
    // roll, pitch and yaw equal those about the body axes.
    let (p_sigma, r_sigma) = (ned_from_world(position_sigma_m), rotation_sigma_rad);
    let sigmas = [p_sigma.x, p_sigma.y, p_sigma.z, r_sigma.x, r_sigma.y, r_sigma.z];
    for (diagonal, sigma) in [0, 6, 11, 15, 18, 20].into_iter().zip(sigmas) {
        covariance[diagonal] = (sigma * sigma) as f32;
    }
    VISION_POSITION_ESTIMATE_DATA {
        usec,
        x: p.x as f32,
        y: p.y as f32,
        z: p.z as f32,
        roll: roll as f32,
        pitch: pitch as f32,
        yaw: yaw as f32,
        covariance,
        reset_counter,
    }
}

/// Returns the external navigation message for a localized pose that was measured at `stamp`. The stated uncertainty
/// has a minimum, so that the autopilot does not overestimate the accuracy.
pub fn vision_of_sample(sample: &PoseSample, stamp: HostTime) -> VISION_POSITION_ESTIMATE_DATA {
    // The autopilot converts this clock to its own.
    let usec = stamp.as_ns() / 1000;
    let p_sigma_m = sample.position_sigma_m.as_dvec3().max(VISION_SIGMA_M);
    let r_sigma_rad = sample.rotation_sigma_rad.as_dvec3().max(VISION_SIGMA_RAD);
    vision_to_mavlink(&sample.world_from_body, usec, sample.resets, p_sigma_m, r_sigma_rad)
}

/// Minimum standard deviation stated with a pose. Errors of successive fused poses are correlated, but the autopilot's
/// filter treats them as independent. [m]
const VISION_SIGMA_M: DVec3 = DVec3::splat(0.02);
/// Minimum standard deviation of attitudes: about one degree. [rad]
const VISION_SIGMA_RAD: DVec3 = DVec3::splat(0.02);

/// Reads the external navigation message.
pub fn vision_from_mavlink(message: &VISION_POSITION_ESTIMATE_DATA) -> Pose<World, Body> {
    Pose::new(
        world_from_ned(DVec3::new(message.x.into(), message.y.into(), message.z.into())),
        attitude_of_euler(message.roll, message.pitch, message.yaw),
    )
}

/// Returns ATTITUDE for an attitude and an angular velocity [rad/s, body].
///
/// ```
/// use glam::{DQuat, DVec3};
/// use vizflyt_protocol::mavlink::{attitude_from_mavlink, attitude_to_mavlink};
/// // Facing north, rolled 10 degrees to the right: rotation about body x is the same in FRD.
/// let q = DQuat::from_rotation_z(90f64.to_radians()) * DQuat::from_rotation_x(10f64.to_radians());
/// let message = attitude_to_mavlink(q, DVec3::new(0.1, 0.2, 0.3), 7);
/// assert!((message.roll - 10f32.to_radians()).abs() < 1e-6 && message.yaw.abs() < 1e-6);
/// assert_eq!((message.rollspeed, message.pitchspeed, message.yawspeed), (0.1, -0.2, -0.3));
/// let (back, omega_body) = attitude_from_mavlink(&message);
/// assert!(back.dot(q).abs() > 1.0 - 1e-9 && (omega_body - DVec3::new(0.1, 0.2, 0.3)).length() < 1e-6);
/// ```
pub fn attitude_to_mavlink(
    world_from_body: DQuat,
    omega_body_radps: DVec3,
    time_boot_ms: u32,
) -> ATTITUDE_DATA {
    let (roll, pitch, yaw) = euler_ned(world_from_body);
    let rates = frd_from_body(omega_body_radps);
    ATTITUDE_DATA {
        time_boot_ms,
        roll: roll as f32,
        pitch: pitch as f32,
        yaw: yaw as f32,
        rollspeed: rates.x as f32,
        pitchspeed: rates.y as f32,
        yawspeed: rates.z as f32,
    }
}

/// Reads ATTITUDE: body-to-world rotation and angular velocity. [rad/s, body]
pub fn attitude_from_mavlink(message: &ATTITUDE_DATA) -> (DQuat, DVec3) {
    let rates =
        DVec3::new(message.rollspeed.into(), message.pitchspeed.into(), message.yawspeed.into());
    (attitude_of_euler(message.roll, message.pitch, message.yaw), body_from_frd(rates))
}

/// Returns LOCAL_POSITION_NED for a position [m, world] and a velocity [m/s, world].
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::local_position_to_mavlink;
/// let m = local_position_to_mavlink(DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.5, 0.0, -1.0), 7);
/// assert_eq!((m.x, m.y, m.z), (2.0, 1.0, -3.0));
/// assert_eq!((m.vx, m.vy, m.vz), (0.0, 0.5, 1.0));
/// ```
pub fn local_position_to_mavlink(
    p_world_m: DVec3,
    v_world_mps: DVec3,
    time_boot_ms: u32,
) -> LOCAL_POSITION_NED_DATA {
    let (p, v) = (ned_from_world(p_world_m), ned_from_world(v_world_mps));
    LOCAL_POSITION_NED_DATA {
        time_boot_ms,
        x: p.x as f32,
        y: p.y as f32,
        z: p.z as f32,
        vx: v.x as f32,
        vy: v.y as f32,
        vz: v.z as f32,
    }
}

/// Reads LOCAL_POSITION_NED: position [m, world] and velocity [m/s, world].
pub fn local_position_from_mavlink(message: &LOCAL_POSITION_NED_DATA) -> (DVec3, DVec3) {
    let vector = |x: f32, y: f32, z: f32| world_from_ned(DVec3::new(x.into(), y.into(), z.into()));
    (vector(message.x, message.y, message.z), vector(message.vx, message.vy, message.vz))
}

/// Reads RAW_IMU: specific force [m/s^2, body] and angular velocity [rad/s, body].
///
/// MAVLink does not define its units. ArduCopter sends mG and mrad/s (GCS_MAVLINK::send_raw_imu).
///
/// ```
/// use glam::DVec3;
/// use vizflyt_protocol::mavlink::{dialect::RAW_IMU_DATA, raw_imu_from_mavlink};
/// // Level and at rest, turning right at 0.5 rad/s: the specific force points up, -z in FRD.
/// let message = RAW_IMU_DATA { zacc: -1000, zgyro: 500, ..Default::default() };
/// let (accel_mps2, gyro_radps) = raw_imu_from_mavlink(&message);
/// assert_eq!((accel_mps2, gyro_radps), (DVec3::Z * 9.80665, DVec3::Z * -0.5));
/// ```
pub fn raw_imu_from_mavlink(message: &RAW_IMU_DATA) -> (DVec3, DVec3) {
    let vector = |x: i16, y: i16, z: i16| body_from_frd(DVec3::new(x.into(), y.into(), z.into()));
    (
        vector(message.xacc, message.yacc, message.zacc) * (GRAVITY_MPS2 / 1000.0),
        vector(message.xgyro, message.ygyro, message.zgyro) / 1000.0,
    )
}

/// Reads HIGHRES_IMU: specific force [m/s^2, body] and angular velocity [rad/s, body].
pub fn highres_imu_from_mavlink(message: &HIGHRES_IMU_DATA) -> (DVec3, DVec3) {
    let vector = |x: f32, y: f32, z: f32| body_from_frd(DVec3::new(x.into(), y.into(), z.into()));
    (
        vector(message.xacc, message.yacc, message.zacc),
        vector(message.xgyro, message.ygyro, message.zgyro),
    )
}

/// Standard gravity, ISO 80000-3. [m/s^2]
const GRAVITY_MPS2: f64 = 9.80665;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn poses_survive_the_wire(
            p in prop::array::uniform3(-50.0..50.0f64),
            yaw in -3.1..3.1f64, pitch in -1.4..1.4f64, roll in -3.1..3.1f64,
        ) {
            let rotation = DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll);
            let pose = Pose::new(DVec3::from(p), rotation);
            let back = vision_from_mavlink(&vision_to_mavlink(&pose, 1, 0, DVec3::ONE, DVec3::ONE));
            prop_assert!((back.translation_m - pose.translation_m).length() < 1e-4);
            prop_assert!(back.rotation.dot(rotation).abs() > 1.0 - 1e-6);
            let (attitude, _) = attitude_from_mavlink(&attitude_to_mavlink(rotation, DVec3::ZERO, 0));
            prop_assert!(attitude.dot(rotation).abs() > 1.0 - 1e-6);
        }
    }
}
