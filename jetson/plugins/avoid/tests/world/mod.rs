//! A small simulated world without a renderer or an autopilot: solids, a depth camera that casts rays at them, and a
//! vehicle that follows velocities with lag, tilt and limits.

pub(crate) mod camera;
pub(crate) mod flight;

use std::f64::consts::TAU;

use vizflyt_sdk::Volume;
use vizflyt_sdk::glam::{DVec2, DVec3};

/// SplitMix64: the same numbers on every platform.
#[derive(Clone, Debug)]
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d)
    }

    /// Uniform in 0..1.
    pub(crate) fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

pub(crate) const FLOOR: Volume = Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 };
pub(crate) const START_M: DVec3 = DVec3::new(1.0, 0.0, 1.2);
pub(crate) const GOAL_M: DVec3 = DVec3::new(38.0, 0.0, 1.2);
pub(crate) const HALF_WIDTH_M: f64 = 6.0;

/// Returns a trunk at `foot_m` with its top displaced by `lean_m`.
pub(crate) fn trunk(foot_m: DVec2, lean_m: DVec2, radius_m: f64) -> Volume {
    let (a_m, b_m) = (foot_m.extend(-0.2), (foot_m + lean_m).extend(5.0));
    Volume::Capsule { a_m, b_m, radius_m }
}

/// Returns the floor and up to `trunks` trunks between start and goal, at least 1.4 m apart.
pub(crate) fn forest(seed: u64, trunks: usize) -> Vec<Volume> {
    let mut random = Random::new(seed);
    let mut placed: Vec<(DVec2, f64)> = Vec::new();
    let mut volumes = vec![FLOOR];
    for _ in 0..100 * trunks {
        if placed.len() == trunks {
            break;
        }
        let at_m =
            DVec2::new(random.between(3.5, 36.0), random.between(-HALF_WIDTH_M, HALF_WIDTH_M));
        let radius_m = random.between(0.12, 0.3);
        let lean_m = DVec2::from_angle(random.between(0.0, TAU)) * random.between(0.0, 0.2);
        let fits = |&(other_m, other_radius_m): &(DVec2, f64)| {
            at_m.distance(other_m) - radius_m - other_radius_m > 1.4
        };
        if placed.iter().all(fits) {
            placed.push((at_m, radius_m));
            volumes.push(trunk(at_m, lean_m, radius_m));
        }
    }
    volumes
}
