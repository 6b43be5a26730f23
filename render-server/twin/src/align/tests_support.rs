//! Random frames and points.

use glam::{DQuat, DVec3};
use proptest::prelude::*;

use super::Similarity;
use crate::random::Random;

/// Returns a vector of the standard normal distribution.
pub(super) fn gauss(random: &mut Random) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| f64::from(random.normal())))
}

fn vector(reach: f64) -> impl Strategy<Value = DVec3> {
    prop::array::uniform3(-reach..reach).prop_map(DVec3::from_array)
}

/// Any position, rotation and scale.
pub(super) fn similarity() -> impl Strategy<Value = Similarity> {
    (0.01..20.0f64, vector(3.0), vector(10.0)).prop_map(|(scale, turn, translation_m)| Similarity {
        scale,
        rotation: DQuat::from_scaled_axis(turn),
        translation_m,
    })
}

pub(super) fn spread(count: std::ops::Range<usize>) -> impl Strategy<Value = Vec<DVec3>> {
    prop::collection::vec(vector(10.0), count)
}
