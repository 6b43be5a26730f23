//! Referee: measures the true flight against the true geometry at every physics step.
//!
//! A distance cannot change faster than the vehicle moves. An obstacle is therefore measured again only if it could
//! have become the nearest, given the distance flown.

use glam::DVec3;
use serde::Serialize;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::mavlink::CopterMode;

use crate::airframe::AirframeState;

/// Height above the floor from which the vehicle counts as flying [m].
const AIRBORNE_M: f64 = 0.05;
/// Ground speed at which a course starts [m/s].
const UNDER_WAY_MPS: f64 = 0.5;

/// Figures of a flight. JSON keys are the field names.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TruthReport {
    /// Minimum distance of the body's surface to an obstacle while airborne [m]; absent without obstacles or flight.
    pub min_clearance_m: Option<f64>,
    /// Position of the minimum clearance [m, world].
    pub min_clearance_at_m: Option<DVec3>,
    /// Whether the body touched an obstacle.
    pub collided: bool,
    /// Mean speed from take-off until LAND was entered [m/s].
    pub mean_speed_mps: f64,
    /// Mean speed from the first motion along the ground, without the take-off [m/s].
    pub mean_speed_under_way_mps: f64,
    /// Maximum speed while airborne [m/s].
    pub max_speed_mps: f64,
    /// Distance flown while airborne [m].
    pub path_m: f64,
    /// Time airborne [s].
    pub flight_seconds: f64,
    /// Whether the vehicle has flown, stands on the floor, and is disarmed.
    pub landed: bool,
    /// Position at the end [m, world].
    pub final_position_m: DVec3,
}

/// Obstacle with its last measured distance.
#[derive(Clone, Debug)]
struct Obstacle {
    volume: Volume,
    /// Last measured distance from the body's centre, plus the distance travelled until then [m].
    distance_plus_path_m: f64,
}

/// Measures one flight.
#[derive(Clone, Debug)]
pub struct Truth {
    obstacles: Vec<Obstacle>,
    body_radius_m: f64,
    floor_z_m: f64,
    last_p: Option<DVec3>,
    /// Distance travelled since the start, also on the ground [m].
    travelled_m: f64,
    nearest: Option<(f64, DVec3)>,
    airborne_s: f64,
    since_take_off_s: f64,
    path_m: f64,
    max_speed_mps: f64,
    course: Mean,
    under_way: Option<Mean>,
    landing: bool,
    landed: bool,
}

/// Accumulator of a mean speed.
#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    path_m: f64,
    seconds: f64,
}

impl Mean {
    fn add(&mut self, path_m: f64, seconds: f64) {
        self.path_m += path_m;
        self.seconds += seconds;
    }

    fn speed_mps(&self) -> f64 {
        if self.seconds > 0.0 { self.path_m / self.seconds } else { 0.0 }
    }
}

impl Truth {
    /// Returns a referee for a body of a radius [m] among obstacles, over a floor at a height [m, world]. Floors among
    /// the obstacles (half-spaces facing up) are excluded, because landing is not a collision.
    pub fn new(obstacles: &[Volume], body_radius_m: f64, floor_z_m: f64) -> Self {
        let is_floor =
            |v: &Volume| matches!(v, Volume::HalfSpace { normal, .. } if normal.z > 0.99);
        Self {
            obstacles: obstacles
                .iter()
                .filter(|volume| !is_floor(volume))
                .map(|&volume| Obstacle { volume, distance_plus_path_m: f64::NEG_INFINITY })
                .collect(),
            body_radius_m,
            floor_z_m,
            last_p: None,
            travelled_m: 0.0,
            nearest: None,
            airborne_s: 0.0,
            since_take_off_s: 0.0,
            path_m: 0.0,
            max_speed_mps: 0.0,
            course: Mean::default(),
            under_way: None,
            landing: false,
            landed: false,
        }
    }

    /// Measures the vehicle after a step of `dt_s`.
    pub fn tick(&mut self, state: &AirframeState, armed: bool, mode: CopterMode, dt_s: f64) {
        let p = state.p_world_m;
        let step_m = (p - self.last_p.unwrap_or(p)).length();
        self.last_p = Some(p);
        self.travelled_m += step_m;
        let airborne = p.z > self.floor_z_m + AIRBORNE_M;
        self.landed = self.airborne_s > 0.0 && !airborne && !armed;
        if airborne || self.since_take_off_s > 0.0 {
            self.since_take_off_s += dt_s;
        }
        if !airborne {
            return;
        }
        self.airborne_s += dt_s;
        self.path_m += step_m;
        self.max_speed_mps = self.max_speed_mps.max(state.v_world_mps.length());
        self.landing |= mode == CopterMode::Land;
        if !self.landing {
            self.course.add(step_m, dt_s);
            if self.under_way.is_none() && state.v_world_mps.truncate().length() > UNDER_WAY_MPS {
                self.under_way = Some(Mean::default());
            }
            if let Some(mean) = &mut self.under_way {
                mean.add(step_m, dt_s);
            }
        }
        self.measure(p);
    }

    /// Returns the time since the first take-off; 0 before [s].
    pub fn since_take_off_s(&self) -> f64 {
        self.since_take_off_s
    }

    fn measure(&mut self, p: DVec3) {
        let mut nearest_m = self.nearest.map_or(f64::INFINITY, |(clearance_m, _)| clearance_m);
        for obstacle in &mut self.obstacles {
            let least_m = obstacle.distance_plus_path_m - self.travelled_m - self.body_radius_m;
            if least_m >= nearest_m {
                continue;
            }
            let distance_m = obstacle.volume.signed_distance_m(p);
            obstacle.distance_plus_path_m = distance_m + self.travelled_m;
            if distance_m - self.body_radius_m < nearest_m {
                nearest_m = distance_m - self.body_radius_m;
                self.nearest = Some((nearest_m, p));
            }
        }
    }

    /// Returns the present figures.
    pub fn report(&self) -> TruthReport {
        TruthReport {
            min_clearance_m: self.nearest.map(|(clearance_m, _)| clearance_m),
            min_clearance_at_m: self.nearest.map(|(_, p)| p),
            collided: self.nearest.is_some_and(|(clearance_m, _)| clearance_m <= 0.0),
            mean_speed_mps: self.course.speed_mps(),
            mean_speed_under_way_mps: self.under_way.unwrap_or_default().speed_mps(),
            max_speed_mps: self.max_speed_mps,
            path_m: self.path_m,
            flight_seconds: self.airborne_s,
            landed: self.landed,
            final_position_m: self.last_p.unwrap_or_default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::airframe::Airframe;
    use proptest::prelude::*;

    fn state(p: DVec3, v: DVec3) -> AirframeState {
        AirframeState {
            p_world_m: p,
            v_world_mps: v,
            ..*Airframe::standing(DVec3::ZERO, 0.0).state()
        }
    }

    fn post(x: f64, y: f64) -> Volume {
        let a_m = DVec3::new(x, y, 0.0);
        Volume::Capsule { a_m, b_m: a_m + DVec3::Z * 3.0, radius_m: 0.1 }
    }

    #[test]
    fn measures_a_flight_past_a_post() {
        let floor = Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 };
        let mut truth = Truth::new(&[floor, post(5.0, 0.5)], 0.12, 0.0);
        let v = DVec3::X * 2.0;
        for i in 0..4000 {
            let p = DVec3::new(f64::from(i) * 0.0025, 0.0, 1.0);
            let mode = if i < 3200 { CopterMode::Guided } else { CopterMode::Land };
            truth.tick(&state(p, v), true, mode, 0.00125);
        }
        let flying = truth.report();
        assert!((flying.min_clearance_m.unwrap() - 0.28).abs() < 1e-6);
        assert!((flying.min_clearance_at_m.unwrap().x - 5.0).abs() < 0.01);
        assert!(!flying.collided && !flying.landed);
        assert!((flying.mean_speed_mps - 2.0).abs() < 0.01);
        assert!((flying.flight_seconds - 5.0).abs() < 0.01 && (flying.path_m - 10.0).abs() < 0.01);
        truth.tick(&state(DVec3::X * 10.0, DVec3::ZERO), false, CopterMode::Land, 0.00125);
        assert!(truth.report().landed);
    }

    #[test]
    fn contact_with_an_obstacle_but_not_with_the_floor_is_a_collision() {
        let mut truth = Truth::new(&[post(1.0, 0.0)], 0.12, 0.0);
        truth.tick(&state(DVec3::new(0.85, 0.0, 0.0), DVec3::ZERO), true, CopterMode::Guided, 0.01);
        assert_eq!(truth.report().min_clearance_m, None, "not measured on the ground");
        truth.tick(&state(DVec3::new(0.85, 0.0, 1.0), DVec3::ZERO), true, CopterMode::Guided, 0.01);
        assert!(truth.report().collided);
    }

    proptest! {
        /// Skipping far obstacles does not change the result.
        #[test]
        fn skipping_is_exact(
            posts in prop::collection::vec((-5.0..5.0f64, -5.0..5.0f64), 1..30),
            steps in prop::collection::vec((-0.4..0.4f64, -0.4..0.4f64), 1..100),
        ) {
            let volumes: Vec<_> = posts.iter().map(|&(x, y)| post(x, y)).collect();
            let mut truth = Truth::new(&volumes, 0.12, 0.0);
            let mut p = DVec3::Z;
            let mut expected = f64::INFINITY;
            for (x, y) in steps {
                p += DVec3::new(x, y, 0.0);
                truth.tick(&state(p, DVec3::ZERO), true, CopterMode::Guided, 0.00125);
                for volume in &volumes {
                    expected = expected.min(volume.signed_distance_m(p) - 0.12);
                }
            }
            prop_assert!((truth.report().min_clearance_m.unwrap() - expected).abs() < 1e-9);
        }
    }
}
