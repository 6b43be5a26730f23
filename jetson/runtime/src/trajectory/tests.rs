use std::f64::consts::{FRAC_PI_2, TAU};

use vizflyt_protocol::messages::{COEFFICIENTS, Piece, Waypoint};

use super::*;

const DT_S: f64 = 0.02;
const LIMITS: (f64, f64) = (3.0, 4.0);

fn start() -> Start {
    Start { p_world_m: DVec3::Z, rotation: DQuat::IDENTITY }
}

fn way(points: &[(DVec3, f64)]) -> Trajectory {
    let point = |&(p_m, speed_mps): &(DVec3, f64)| Waypoint { p_m, speed_mps };
    Trajectory { path: Path::Waypoints(points.iter().map(point).collect()), ..Default::default() }
}

/// Follows to the end with a vehicle at the reference; returns the references.
fn follow(trajectory: Trajectory, start: &Start) -> Vec<Reference> {
    let mut follower = Follower::new(trajectory, start);
    let (mut p_m, mut references) = (follower.place().0, Vec::new());
    while !follower.is_over() && references.len() < 5000 {
        let reference = follower.advance(p_m, LIMITS, DT_S);
        p_m = reference.p_world_m;
        references.push(reference);
    }
    assert!(follower.is_over());
    references
}

#[test]
fn passes_waypoints_in_order_within_their_speeds() {
    let points =
        [(DVec3::new(4.0, 0.0, 1.0), 2.0), (DVec3::new(4.0, 3.0, 1.0), 9.0), (DVec3::Z, 1.0)];
    let references = follow(way(&points), &start());
    let mut from = 0;
    for (p_m, _) in points {
        let at = references[from..].iter().position(|r| (r.p_world_m - p_m).length() < 0.1);
        from += at.unwrap_or_else(|| panic!("{p_m} is not passed"));
    }
    let fastest = |is: fn(DVec3) -> bool| {
        let on = references.iter().filter(|r| is(r.p_world_m));
        on.map(|r| r.v_world_mps.length()).fold(0.0, f64::max)
    };
    assert!((fastest(|p| p.y < 1e-9) - 2.0).abs() < 1e-9, "the first leg's speed");
    let second = fastest(|p| p.x > 4.0 - 1e-9 && p.y > 0.1);
    assert!(second > 2.0 && second <= 3.0, "{second}: up to the limit");
    for pair in references.windows(2) {
        let change = pair[1].v_world_mps.length() - pair[0].v_world_mps.length();
        // The last tick before a stop may change more; the guard smooths it.
        assert!(change.abs() <= 2.0 * LIMITS.1 * DT_S, "{change}");
    }
    let last = references.last().unwrap();
    assert!((last.p_world_m - DVec3::Z).length() < 1e-6);
    assert_eq!(last.v_world_mps, DVec3::ZERO);
}

#[test]
fn slows_down_at_corners() {
    let points = [(DVec3::new(4.0, 0.0, 1.0), 3.0), (DVec3::new(4.0, 4.0, 1.0), 3.0)];
    let references = follow(way(&points), &start());
    let near = references.iter().filter(|r| (r.p_world_m - points[0].0).length() < 0.02);
    let fastest = near.map(|r| r.v_world_mps.length()).fold(0.0, f64::max);
    // a CORNER_S / sqrt(2), and the change within 2 cm.
    assert!(fastest < 0.55, "{fastest} m/s");
}

#[test]
fn relative_axes_start_at_the_vehicle() {
    let pitched = DQuat::from_rotation_z(FRAC_PI_2) * DQuat::from_rotation_y(0.5);
    let start = Start { p_world_m: DVec3::new(1.0, 2.0, 3.0), rotation: pitched };
    let end = |axes| {
        let trajectory = Trajectory { axes, ..way(&[(DVec3::X * 2.0, 1.0)]) };
        follow(trajectory, &start).last().unwrap().p_world_m
    };
    assert!((end(Axes::Heading) - DVec3::new(1.0, 4.0, 3.0)).length() < 1e-6);
    // Pitched nose down by 0.5 rad.
    let body = DVec3::new(1.0, 2.0 + 2.0 * 0.5_f64.cos(), 3.0 - 2.0 * 0.5_f64.sin());
    assert!((end(Axes::Body) - body).length() < 1e-6, "{}", end(Axes::Body));
    assert!((end(Axes::World) - DVec3::X * 2.0).length() < 1e-6);
}

#[test]
fn follows_a_polynomial_in_its_time() {
    // Two seconds out by t^2, then two back at constant speed.
    let mut out = Piece { seconds: 2.0, coefficients: [DVec3::ZERO; COEFFICIENTS] };
    out.coefficients[2] = DVec3::X * 0.5;
    let mut back = Piece { seconds: 2.0, coefficients: [DVec3::ZERO; COEFFICIENTS] };
    (back.coefficients[0], back.coefficients[1]) = (DVec3::X * 2.0, -DVec3::X);
    let path = Path::Polynomial([out, back].into_iter().collect());
    let trajectory = Trajectory { axes: Axes::Heading, path, ..Default::default() };
    let references = follow(trajectory, &start());
    assert_eq!(references.len(), 200);
    assert!((references[49].p_world_m - DVec3::new(0.5, 0.0, 1.0)).length() < 1e-6);
    assert!((references[49].v_world_mps - DVec3::X).length() < 1e-6);
    assert!((references[149].v_world_mps + DVec3::X).length() < 1e-6);
    assert_eq!(references[49].yaw, YawTarget::Angle(0.0));
    assert!((references[199].p_world_m - DVec3::Z).length() < 1e-6);
}

#[test]
fn reference_waits_for_the_vehicle() {
    let mut follower = Follower::new(way(&[(DVec3::new(9.0, 0.0, 1.0), 3.0)]), &start());
    for _ in 0..500 {
        let reference = follower.advance(DVec3::Z, LIMITS, DT_S);
        assert!(reference.p_world_m.x <= MAX_LAG_M, "{}", reference.p_world_m);
    }
    assert!(!follower.is_over());
    // The reference does not move if the vehicle is far from the start of a polynomial.
    let mut circle = Piece { seconds: TAU, coefficients: [DVec3::X * 7.0; COEFFICIENTS] };
    circle.coefficients[1] = DVec3::Y;
    let path = Path::Polynomial([circle].into_iter().collect());
    let mut follower = Follower::new(Trajectory { path, ..Default::default() }, &start());
    let reference = follower.advance(DVec3::Z, LIMITS, DT_S);
    assert_eq!((reference.p_world_m, reference.v_world_mps), (DVec3::X * 7.0, DVec3::ZERO));
}

#[test]
fn path_without_length_ends_at_once() {
    let points = [(DVec3::Z, 1.0), (DVec3::Z, 1.0)];
    let references = follow(way(&points), &start());
    assert_eq!(references.len(), 1);
    assert_eq!((references[0].p_world_m, references[0].v_world_mps), (DVec3::Z, DVec3::ZERO));
    assert_eq!(references[0].yaw, YawTarget::Keep);
}
