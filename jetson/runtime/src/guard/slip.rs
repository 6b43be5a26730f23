//! Drift of positions that a plugin gives relative to the vehicle, if the course withholds the pose.
//!
//! The guard knows the true pose, but a vehicle in such a course does not: it would fly a metre forward by cameras and
//! IMU, and such odometry is off by about 1 % of the distance. So that flying blind is not better than using images,
//! positions drift by [`SHARE`] of the distance flown. The direction depends on the seed of the flight and turns along
//! the way.

use glam::DVec3;
use vizflyt_protocol::geometry::wrap_pi;
use vizflyt_protocol::random;

/// Share of the distance flown.
const SHARE: f64 = 0.01;
/// Distance in which the direction turns to the next random angle. [m]
const TURN_M: f64 = 3.0;

/// Simulated drift of the position that the plugin has set.
#[derive(Clone, Debug)]
pub(super) struct Slip {
    /// Different for each flight.
    seed: u64,
    /// Distance flown since the flight began. [m]
    way_m: f64,
    last_m: Option<DVec3>,
    /// Drift since the position was given. [m, world]
    slip_m: DVec3,
}

impl Slip {
    pub(super) fn new(seed: u64) -> Self {
        Self { seed, way_m: 0.0, last_m: None, slip_m: DVec3::ZERO }
    }

    /// Records that the vehicle is at `p_world_m`.
    pub(super) fn advance(&mut self, p_world_m: DVec3) {
        let Some(last_m) = self.last_m.replace(p_world_m) else { return };
        let step_m = (p_world_m - last_m).length();
        self.way_m += step_m;
        self.slip_m += self.side() * (SHARE * step_m);
    }

    /// Resets the drift, for a new position.
    pub(super) fn restart(&mut self) {
        self.slip_m = DVec3::ZERO;
    }

    /// Returns the drift since the plugin set the position. [m, world]
    pub(super) fn slip_m(&self) -> DVec3 {
        self.slip_m
    }

    /// Returns the present direction of drift: horizontal, because floor and barometer give the height.
    fn side(&self) -> DVec3 {
        let turns = self.way_m / TURN_M;
        let (from, to) = (self.angle_rad(turns.floor()), self.angle_rad(turns.floor() + 1.0));
        let angle_rad = from + wrap_pi(to - from) * turns.fract();
        DVec3::new(angle_rad.cos(), angle_rad.sin(), 0.0)
    }

    /// Returns the random angle with this number, from 0 to a whole turn.
    fn angle_rad(&self, number: f64) -> f64 {
        random::nth(self.seed, number as u64) as f64 / u64::MAX as f64 * std::f64::consts::TAU
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(seed: u64, way_m: f64) -> DVec3 {
        let mut slip = Slip::new(seed);
        for step in 0..=(way_m * 100.0) as u32 {
            slip.advance(DVec3::new(f64::from(step) * 0.01, 0.0, 1.0));
        }
        slip.slip_m()
    }

    #[test]
    fn positions_drift_by_one_percent_in_a_random_direction() {
        let slips: Vec<DVec3> = (0..40).map(|seed| after(seed, 2.0)).collect();
        for slip_m in &slips {
            assert!((0.002..=0.0201).contains(&slip_m.length()) && slip_m.z == 0.0, "{slip_m}");
        }
        let mean_m = slips.iter().sum::<DVec3>() / slips.len() as f64;
        assert!(mean_m.length() < 0.008, "the direction is not uniform: {mean_m}");
        assert_eq!(after(7, 2.0), after(7, 2.0));
        let mut still = Slip::new(7);
        (0..100).for_each(|_| still.advance(DVec3::Z));
        assert_eq!(still.slip_m(), DVec3::ZERO, "no drift at rest");
    }
}
