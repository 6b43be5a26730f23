use vizflyt_sdk::Volume;
use vizflyt_sdk::glam::{DQuat, DVec3};

use super::*;
use crate::field::Surroundings;

const SPEED_MPS: f64 = 4.0;

fn field(points_m: &[DVec2]) -> Field {
    let geofence = Volume::Cuboid {
        center_m: DVec3::ZERO,
        half_m: DVec3::new(50.0, 7.0, 4.0),
        rotation: DQuat::IDENTITY,
    };
    let mut field = Field::default();
    let around = Surroundings {
        p_m: DVec3::ZERO,
        goal_m: DVec2::new(30.0, 0.0),
        geofence: &geofence,
        body_radius_m: 0.12,
    };
    field.update(&around, points_m.iter().map(|p_m| p_m.extend(0.0)));
    field
}

fn moving(v_mps: DVec2) -> PlanarState {
    PlanarState { p_m: DVec2::ZERO, v_mps, setpoint_mps: v_mps, heading_rad: 0.0, late_s: 0.0 }
}

#[test]
fn flies_straight_at_full_speed_without_obstacles() {
    let v_mps = choose_velocity(&field(&[]), &moving(DVec2::X * SPEED_MPS), SPEED_MPS);
    assert!(v_mps.distance(DVec2::X * SPEED_MPS) < 1e-9, "{v_mps}");
}

/// Continues with an ideal vehicle and returns the smallest distance to the points. [m]
fn least_distance_m(points_m: &[DVec2]) -> f64 {
    let field = field(points_m);
    let mut motion = moving(DVec2::X * SPEED_MPS);
    let mut least_m = f64::INFINITY;
    for _ in 0..60 {
        let wanted_mps = choose_velocity(&field, &motion, SPEED_MPS);
        motion.setpoint_mps = slew(motion.setpoint_mps, wanted_mps, 0.02);
        motion.v_mps += (motion.setpoint_mps - motion.v_mps) * (0.02 / LAG_S);
        motion.p_m += motion.v_mps * 0.02;
        for point_m in points_m {
            least_m = least_m.min(motion.p_m.distance(*point_m));
        }
    }
    least_m
}

#[test]
fn swerves_around_an_obstacle_ahead() {
    assert!(least_distance_m(&[DVec2::new(3.0, 0.0)]) > 0.3);
    assert!(least_distance_m(&[DVec2::new(3.0, -0.1), DVec2::new(3.0, 0.3)]) > 0.3);
}

#[test]
fn stops_in_front_of_a_wall() {
    let wall_m: Vec<DVec2> = (-40..=40).map(|n| DVec2::new(3.5, f64::from(n) * 0.1)).collect();
    assert!(least_distance_m(&wall_m) > 0.15);
}

#[test]
fn flies_slowly_into_unseen_space() {
    let looking_back = PlanarState { heading_rad: PI, ..moving(DVec2::ZERO) };
    let v_mps = choose_velocity(&field(&[]), &looking_back, SPEED_MPS);
    assert!(v_mps.x > 0.5 && v_mps.length() <= UNSEEN_MPS + 1e-9, "{v_mps}");
}

#[test]
fn setpoint_changes_no_faster_than_the_vehicle_can() {
    let step_mps = slew(DVec2::ZERO, DVec2::X * SPEED_MPS, 0.02);
    assert!((step_mps - DVec2::X * (SLEW_MPS2 * 0.02)).length() < 1e-12);
    assert_eq!(slew(DVec2::X, DVec2::X, 0.0), DVec2::X);
}
