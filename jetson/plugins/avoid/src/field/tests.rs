use proptest::prelude::*;
use vizflyt_sdk::glam::DQuat;

use super::*;

fn fence() -> Volume {
    Volume::Cuboid {
        center_m: DVec3::new(20.0, 0.0, 1.75),
        half_m: DVec3::new(22.0, 7.0, 2.25),
        rotation: DQuat::IDENTITY,
    }
}

fn field(p_m: DVec2, goal_m: DVec2, points_m: &[DVec2]) -> Field {
    let mut field = Field::default();
    let around =
        Surroundings { p_m: p_m.extend(1.2), goal_m, geofence: &fence(), body_radius_m: 0.12 };
    field.update(&around, points_m.iter().map(|p_m| p_m.extend(1.2)));
    field
}

/// Returns a wall of points at this x from `low_y` to `high_y`.
fn wall(x: f64, low_y: f64, high_y: f64) -> Vec<DVec2> {
    let count = ((high_y - low_y) / 0.1) as usize;
    (0..=count).map(|n| DVec2::new(x, low_y + 0.1 * n as f64)).collect()
}

const P_M: DVec2 = DVec2::new(5.0, 0.0);

#[test]
fn way_is_straight_without_obstacles() {
    for goal_m in [DVec2::new(38.0, 0.0), DVec2::new(10.0, 3.0), DVec2::new(2.0, -4.0)] {
        let field = field(P_M, goal_m, &[]);
        let straight_m = P_M.distance(goal_m);
        // The upwind scheme is of first order: it overestimates diagonals by a few per cent.
        assert!((field.to_go_m(P_M) / straight_m - 1.0).abs() < 0.06, "{goal_m}");
    }
}

#[test]
fn wall_adds_the_detour_to_the_way() {
    let field = field(P_M, DVec2::new(11.0, 0.0), &wall(8.0, -4.0, 3.0));
    let around_m = 2.0 * 3.0_f64.hypot(3.5);
    let found_m = field.to_go_m(P_M);
    assert!(found_m > around_m && found_m < 1.4 * around_m, "{found_m} of {around_m}");
    // The shorter side is the left one, so the way descends to the left.
    assert!(field.to_go_m(P_M + DVec2::Y) < field.to_go_m(P_M - DVec2::Y));
}

#[test]
fn clearance_is_the_distance_to_the_nearest_point_or_the_fence() {
    let field = field(P_M, DVec2::new(38.0, 0.0), &[DVec2::new(6.0, 0.0)]);
    for distance_m in [0.3, 0.5, 0.7] {
        let found_m = field.clearance_m(DVec2::new(6.0 - distance_m, 0.0));
        assert!((found_m - (distance_m - 0.12)).abs() < 0.03, "{found_m} at {distance_m}");
    }
    assert_eq!(field.clearance_m(DVec2::new(3.0, 0.0)), COMFORT_M);
    let beside_fence_m = field.clearance_m(DVec2::new(5.0, 6.2));
    assert!((beside_fence_m - (0.8 - 0.12 - FENCE_MARGIN_M)).abs() < 0.03);
}

#[test]
fn way_out_of_a_closed_ring_is_finite() {
    let ring: Vec<DVec2> =
        (0..80).map(|n| P_M + DVec2::from_angle(f64::from(n) * 0.0785) * 2.0).collect();
    let field = field(P_M, DVec2::new(38.0, 0.0), &ring);
    assert!(field.to_go_m(P_M) < 200.0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Every free cell has a neighbour with a shorter way to the goal, so there are no local minima.
    #[test]
    fn goal_is_the_only_minimum(
        points in prop::collection::vec((-2.0..14.0f64, -6.0..6.0f64), 0..120),
        goal in (-1.0..40.0f64, -5.0..5.0f64),
    ) {
        let points_m: Vec<DVec2> = points.into_iter().map(DVec2::from).collect();
        let goal_m = DVec2::from(goal);
        let field = field(P_M, goal_m, &points_m);
        for row in 1..SIDE - 1 {
            for column in 1..SIDE - 1 {
                let at = index(column, row);
                if field.centre_m(column, row).distance(goal_m) < CELL_M {
                    continue;
                }
                let lowest = [at - 1, at + 1, at - PITCH, at + PITCH]
                    .into_iter()
                    .map(|beside| field.to_go_m[beside])
                    .fold(f64::INFINITY, f64::min);
                prop_assert!(lowest < field.to_go_m[at]);
            }
        }
    }

    #[test]
    fn field_is_finite_everywhere(x in -50.0..90.0f64, y in -50.0..50.0f64) {
        let field = field(P_M, DVec2::new(38.0, 0.0), &wall(8.0, -4.0, 3.0));
        let p_m = DVec2::new(x, y);
        prop_assert!(field.clearance_m(p_m).is_finite() && field.to_go_m(p_m).is_finite());
    }
}
