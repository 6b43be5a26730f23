//! Spatial order of splats, for formats that pack runs of neighbouring splats relative to each
//! other.

use crate::Splats;

/// Returns the indices of all splats along the Z-order curve through their bounding box.
pub(super) fn morton(splats: &Splats) -> Vec<u32> {
    let (mut low, mut high) = (glam::Vec3::INFINITY, glam::Vec3::NEG_INFINITY);
    for &mean_m in &splats.means_m {
        low = low.min(mean_m);
        high = high.max(mean_m);
    }
    // A flat scene has no extent along one axis; there, any step is valid.
    let step = 1023.0 / (high - low).max(glam::Vec3::splat(f32::MIN_POSITIVE));
    let mut keyed: Vec<(u32, u32)> = splats
        .means_m
        .iter()
        .zip(0..)
        .map(|(&mean_m, i)| {
            // `as` saturates, and converts NaN to 0.
            let cell = (mean_m - low) * step;
            (spread(cell.x as u32) | spread(cell.y as u32) << 1 | spread(cell.z as u32) << 2, i)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// Returns the ten lowest bits, each followed by two zeros.
fn spread(cell: u32) -> u32 {
    let mut bits = cell.min(1023);
    bits = (bits | bits << 16) & 0x0300_00ff;
    bits = (bits | bits << 8) & 0x0300_f00f;
    bits = (bits | bits << 4) & 0x030c_30c3;
    (bits | bits << 2) & 0x0924_9249
}
