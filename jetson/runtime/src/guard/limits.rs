//! Limits of the guard, and the check that the guard can enforce the limits of an arena.

use glam::DVec3;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{ArenaInfo, Limits, Path, PoseAges, Setpoint};

/// If slew limit and fence contradict at a flat face, the acceleration limit may be exceeded by at most this factor.
pub(super) const FENCE_EXCESS: f64 = 1.2;
/// Standard gravity, ISO 80000-3. [m/s^2]
pub(super) const GRAVITY_MPS2: f64 = 9.80665;

/// Checks that the guard can enforce the limits and the fence.
///
/// # Errors
/// Returns one sentence that names the setting.
pub fn check_arena(arena: &ArenaInfo) -> Result<(), String> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    if !arena.geofence.is_valid() {
        return Err("arena: geofence is not a volume".into());
    }
    if !arena.no_fly.iter().all(Volume::is_valid) || !arena.floor_z_m.is_finite() {
        return Err("arena: no_fly must be volumes, and floor_z_m a number".into());
    }
    if !positive(arena.limits.max_speed_mps) || !positive(arena.limits.max_acceleration_mps2) {
        return Err("arena: limits must be positive numbers".into());
    }
    if arena.limits.max_tilt_deg.is_some_and(|tilt_deg| !(1.0..=90.0).contains(&tilt_deg)) {
        return Err("arena: limits.max_tilt_deg must be within 1 to 90 degrees".into());
    }
    if let Some(ceiling_m) = arena.limits.max_altitude_m
        && !(ceiling_m.is_finite() && ceiling_m > arena.takeoff_height_m)
    {
        return Err(format!(
            "limits.max_altitude_m = {ceiling_m}: the take-off rises to {} m; allow more",
            arena.takeoff_height_m
        ));
    }
    if !(arena.body_radius_m.is_finite() && arena.body_radius_m >= 0.0) {
        return Err("arena: body_radius_m must be a number, 0 or more".into());
    }
    if !positive(arena.takeoff_height_m) {
        return Err("arena: takeoff_height_m must be a positive number".into());
    }
    let PoseAges { hold_after_s, land_after_s } = arena.pose_ages;
    if !(positive(hold_after_s) && land_after_s.is_finite() && land_after_s > hold_after_s) {
        return Err("arena: pose.land_after_s must exceed pose.hold_after_s, both positive".into());
    }
    if let Volume::Cuboid { half_m, .. } = arena.geofence
        && half_m.min_element() <= arena.body_radius_m
    {
        return Err("arena: geofence is too small for the body".into());
    }
    Ok(())
}

/// Returns the acceleration that keeps the limits of both acceleration and tilt. Thrust that balances gravity and
/// accelerates by `a` in the worst direction tilts the vehicle by asin(a / g). [m/s^2]
pub(super) fn acceleration_within_tilt_mps2(limits: &Limits) -> f64 {
    let by_tilt = |tilt_deg: f64| GRAVITY_MPS2 * tilt_deg.to_radians().sin() / FENCE_EXCESS;
    let by_tilt_mps2 = limits.max_tilt_deg.map_or(f64::INFINITY, by_tilt);
    limits.max_acceleration_mps2.min(by_tilt_mps2)
}

/// Bounds all components, so that a product of two cannot overflow. A million metres is beyond every fence, a million
/// metres per second beyond every limit.
pub(super) fn bound_components(setpoint: Setpoint) -> Setpoint {
    let bound = |v: DVec3| v.clamp(DVec3::splat(-1e6), DVec3::splat(1e6));
    match setpoint {
        Setpoint::Hold | Setpoint::Land | Setpoint::TakeOff => setpoint,
        Setpoint::AttitudeRate { omega_body_radps, thrust } => {
            Setpoint::AttitudeRate { omega_body_radps: bound(omega_body_radps), thrust }
        }
        Setpoint::Offset { d_m, axes, yaw } => Setpoint::Offset { d_m: bound(d_m), axes, yaw },
        Setpoint::Trajectory(mut trajectory) => {
            match &mut trajectory.path {
                Path::Waypoints(points) => {
                    for point in points {
                        point.p_m = bound(point.p_m);
                        point.speed_mps = point.speed_mps.min(1e6);
                    }
                }
                Path::Polynomial(pieces) => {
                    for piece in pieces {
                        piece.seconds = piece.seconds.min(1e6);
                        piece.coefficients = piece.coefficients.map(bound);
                    }
                }
            }
            Setpoint::Trajectory(trajectory)
        }
        Setpoint::Position { p_world_m, yaw } => {
            Setpoint::Position { p_world_m: bound(p_world_m), yaw }
        }
        Setpoint::Velocity { v_mps, axes, yaw } => {
            Setpoint::Velocity { v_mps: bound(v_mps), axes, yaw }
        }
        Setpoint::Acceleration { a_mps2, axes, yaw } => {
            Setpoint::Acceleration { a_mps2: bound(a_mps2), axes, yaw }
        }
    }
}
