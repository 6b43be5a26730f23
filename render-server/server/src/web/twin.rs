//! The twin's splats for the page's view in space: those that make most of the picture, as SPZ files. In
//! parts, the weightiest first, so that something is seen soon and a weak machine can leave the rest.
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

/// Splats of each part: what is drawn in software, what a phone takes, what a laptop's card draws.
const PARTS: [usize; 3] = [40_000, 160_000, 300_000];
/// What stands where the vehicle flies counts so many times: trunks beside a floor of larger splats.
const WITHIN: f32 = 8.0;
/// The floor's height above the fence's lower side. [m]
const FLOOR_M: f32 = 0.15;
/// Positions of 24 bits; read by whoever knows SPZ.
const SPZ_VERSION: u32 = 2;

/// The parts of a twin; each is packed when it is first asked for.
#[derive(Clone, Default)]
pub struct TwinParts(Vec<Arc<LazyLock<Bytes, Pack>>>);

type Pack = Box<dyn FnOnce() -> Bytes + Send>;

impl TwinParts {
    /// Chooses what a viewer about the box from `min_m` to `max_m` [m, world] sees most of.
    pub fn choose(splats: &Splats, min_m: DVec3, max_m: DVec3) -> Self {
        let middle = ((min_m + max_m) / 2.0).as_vec3();
        let reach_m = ((max_m - min_m).length() / 2.0) as f32;
        let (low, high) = (min_m.as_vec3() + FLOOR_M * Vec3::Z, max_m.as_vec3());
        let weight = |k: usize| {
            let [a, b, c] = splats.scales_m[k].to_array();
            // The area of its greatest face, as large as it looks from the box's edge.
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

    /// Returns how many there are.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns part `index`, packed now if nobody has asked before: some tenths of a second.
    pub fn get(&self, index: usize) -> Option<Bytes> {
        self.0.get(index).map(|part| Bytes::clone(part))
    }
}

impl fmt::Debug for TwinParts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("TwinParts").field(&self.len()).finish()
    }
}

/// Returns some of a scene's splats, in their constant colour.
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

    /// Splats along x, the further the smaller; every tenth is faint.
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
    fn the_weightiest_come_first_and_nothing_twice() {
        let splats = row(50_000);
        let parts = TwinParts::choose(&splats, DVec3::ZERO, DVec3::splat(4.0));
        assert_eq!(parts.len(), 2);
        let read = |k| parse(&parts.get(k).unwrap(), Format::Spz).unwrap().splats;
        let (first, rest) = (read(0), read(1));
        assert_eq!((first.len(), rest.len()), (PARTS[0], 10_000));
        assert_eq!((first.sh_degree, parts.get(2)), (0, None));
        // The largest is in the first part, no faint one of the far end is.
        let has =
            |splats: &Splats, x: f32| splats.means_m.iter().any(|mean| (mean.x - x).abs() < 4e-4);
        assert!(has(&first, 0.0) && !has(&rest, 0.0));
        assert!(has(&rest, 49.999) && !has(&first, 49.999));
    }

    #[test]
    fn a_small_scene_is_one_part_and_none_is_none() {
        let parts = TwinParts::choose(&row(10), DVec3::ZERO, DVec3::ONE);
        assert_eq!(parts.len(), 1);
        assert!(TwinParts::choose(&row(0), DVec3::ZERO, DVec3::ONE).is_empty());
    }
}
