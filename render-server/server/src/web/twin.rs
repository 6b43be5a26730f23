//! The twin's splats for the page's 3D view: those that dominate the image, as SPZ files. Parts are ordered by
//! importance, so that a first image appears quickly and a slow computer can skip the rest.
//!
//! ```text
//! GET /api/splats/N   part N of the twin, SPZ version 2 without harmonics, gzip
//! ```

use std::fmt;
use std::sync::{Arc, LazyLock};

use axum::body::Bytes;
use glam::{DVec3, Vec3};
use tracing::warn;
use vizflyt_splat::Splats;
use vizflyt_splat::format::{Format, encode_variant};

/// Splats of each part: for rendering in software, for a phone, for a laptop's graphics card.
const PARTS: [usize; 3] = [40_000, 160_000, 300_000];
/// Weight of splats inside the fence: trunks compared with a floor of larger splats.
const WITHIN: f32 = 8.0;
/// Height of the floor above the fence's lower side. [m]
const FLOOR_M: f32 = 0.15;
/// Version with positions of 24 bits, which all SPZ readers support.
const SPZ_VERSION: u32 = 2;

/// Parts of a twin; each is packed on first use.
#[derive(Clone, Default)]
pub struct TwinParts(Vec<Arc<LazyLock<Bytes, Pack>>>);

type Pack = Box<dyn FnOnce() -> Bytes + Send>;

impl TwinParts {
    /// Selects the most visible splats for viewers around the box from `min_m` to `max_m` [m, world].
    pub fn choose(splats: &Splats, min_m: DVec3, max_m: DVec3) -> Self {
        let middle = ((min_m + max_m) / 2.0).as_vec3();
        let reach_m = ((max_m - min_m).length() / 2.0) as f32;
        let (low, high) = (min_m.as_vec3() + FLOOR_M * Vec3::Z, max_m.as_vec3());
        let weight = |k: usize| {
            let [a, b, c] = splats.scales_m[k].to_array();
            // Area of the largest face, scaled by its distance as seen from the box's edge.
            let area = a * b * c / a.min(b).min(c).max(f32::MIN_POSITIVE);
            let mean_m = splats.means_m[k];
            let away_m = mean_m.distance(middle).max(reach_m);
            let is_in = mean_m.cmpgt(low).all() && mean_m.cmplt(high).all();
            let share = if is_in { WITHIN } else { 1.0 };
            share * splats.opacities[k] * area / (away_m * away_m)
        };
        let mut order: Vec<(f32, u32)> = (0..splats.len()).map(|k| (weight(k), k as u32)).collect();
        let mut rest = order.as_mut_slice();
        let mut parts = Vec::new();
        for size in PARTS {
            if rest.is_empty() {
                break;
            }
            if size < rest.len() {
                rest.select_nth_unstable_by(size, |(a, _), (b, _)| b.total_cmp(a));
            }
            let (part, others) = rest.split_at_mut(size.min(rest.len()));
            rest = others;
            let part = select(splats, part.iter().map(|&(_, k)| k as usize));
            let pack: Pack = Box::new(move || pack(&part));
            parts.push(Arc::new(LazyLock::new(pack)));
        }
        Self(parts)
    }

    /// Returns the number of parts.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are no parts.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns part `index`. The first call packs it, which takes some tenths of a second.
    pub fn get(&self, index: usize) -> Option<Bytes> {
        self.0.get(index).map(|part| Bytes::clone(part))
    }
}

impl fmt::Debug for TwinParts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("TwinParts").field(&self.len()).finish()
    }
}

/// Returns the selected splats of a scene, with their constant colour only.
pub(super) fn select(splats: &Splats, kept: impl Iterator<Item = usize> + Clone) -> Splats {
    let per_splat = splats.sh_coefficients() * 3;
    Splats {
        means_m: kept.clone().map(|k| splats.means_m[k]).collect(),
        scales_m: kept.clone().map(|k| splats.scales_m[k]).collect(),
        rotations: kept.clone().map(|k| splats.rotations[k]).collect(),
        opacities: kept.clone().map(|k| splats.opacities[k]).collect(),
        sh_degree: 0,
        sh: kept.flat_map(|k| &splats.sh[k * per_splat..][..3]).copied().collect(),
        antialiased: splats.antialiased,
    }
}

fn pack(splats: &Splats) -> Bytes {
    match encode_variant(Format::Spz, SPZ_VERSION, splats) {
        Ok(bytes) => bytes.into(),
        Err(error) => {
            warn!("page: the twin cannot be shown in space: {error}");
            Bytes::new()
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Quat;
    use vizflyt_splat::format::parse;

    use super::*;

    /// Splats along x, smaller with distance; every tenth is faint.
    fn row(count: usize) -> Splats {
        let each = |k: usize| 0.5 / (1 + k) as f32;
        Splats {
            means_m: (0..count).map(|k| Vec3::new(k as f32 * 1e-3, 1.0, 2.0)).collect(),
            scales_m: (0..count).map(|k| Vec3::splat(each(k).max(1e-3))).collect(),
            rotations: vec![Quat::IDENTITY; count],
            opacities: (0..count).map(|k| if k % 10 == 9 { 0.01 } else { 0.9 }).collect(),
            sh_degree: 1,
            sh: vec![0.25; count * 12],
            antialiased: false,
        }
    }

    #[test]
    fn parts_are_ordered_by_weight_without_duplicates() {
        let splats = row(50_000);
        let parts = TwinParts::choose(&splats, DVec3::ZERO, DVec3::splat(4.0));
        assert_eq!(parts.len(), 2);
        let read = |k| parse(&parts.get(k).unwrap(), Format::Spz).unwrap().splats;
        let (first, rest) = (read(0), read(1));
        assert_eq!((first.len(), rest.len()), (PARTS[0], 10_000));
        assert_eq!((first.sh_degree, parts.get(2)), (0, None));
        // The largest splat is in the first part, the faint one at the far end is not.
        let has =
            |splats: &Splats, x: f32| splats.means_m.iter().any(|mean| (mean.x - x).abs() < 4e-4);
        assert!(has(&first, 0.0) && !has(&rest, 0.0));
        assert!(has(&rest, 49.999) && !has(&first, 49.999));
    }

    #[test]
    fn a_small_scene_has_one_part_and_an_empty_one_none() {
        let parts = TwinParts::choose(&row(10), DVec3::ZERO, DVec3::ONE);
        assert_eq!(parts.len(), 1);
        assert!(TwinParts::choose(&row(0), DVec3::ZERO, DVec3::ONE).is_empty());
    }
}
