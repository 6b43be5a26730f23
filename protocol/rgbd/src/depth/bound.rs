//! Lossy depth with a bounded error: depth is rounded to levels, spaced as widely as the bound allows.
//!
//! The bound grows with the square of depth, as does the noise of stereo and time-of-flight cameras (Khoshelham and
//! Elberink, Sensors 2012, equation 12). So levels are spaced about evenly in inverse depth. A plane in space is nearly
//! a plane in the image of levels, and the same predictor is suitable. Encoder and decoder compute the same table from
//! the header, in integers.

/// Maximum error of a decoded depth: `max(1 mm, k z^2)`, with z as the true depth in metres. The values "no return" and
/// "return" are exact.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthBound(u32);

impl DepthBound {
    /// Returns the bound with this `k`, rounded to the millionth (0.001: 1 mm at 1 m, 25 mm at 5 m); `None` unless it
    /// is 1e-6 to 0.1. [1/m]
    pub fn new(k_per_m: f64) -> Option<Self> {
        let millionths = (k_per_m * 1e6).round();
        if !(1.0..=f64::from(MAX_MILLIONTHS)).contains(&millionths) {
            return None;
        }
        Some(Self(millionths as u32))
    }

    pub(crate) fn from_millionths(millionths: u32) -> Option<Self> {
        (1..=MAX_MILLIONTHS).contains(&millionths).then_some(Self(millionths))
    }

    pub(crate) fn millionths(self) -> u32 {
        self.0
    }

    /// Returns `k`. [1/m]
    pub fn k_per_m(self) -> f64 {
        f64::from(self.0) * 1e-6
    }

    /// Returns the maximum error of a decoded depth for this true depth. [mm]
    pub fn error_mm(self, depth_mm: u16) -> u16 {
        let square = u64::from(depth_mm).pow(2);
        // At least 1 mm, and rounded down to whole millimetres. At most 429484 before the clamp.
        (u64::from(self.0) * square / 1_000_000_000).clamp(1, u64::from(u16::MAX)) as u16
    }
}

/// Maximum depth. [mm]
const MAX_MM: u32 = u16::MAX as u32;
/// Maximum k, 0.1: a third of the depth at 3 m. [millionths]
const MAX_MILLIONTHS: u32 = 100_000;

/// Conversion between depth and level.
#[derive(Clone, Debug)]
pub(crate) struct Levels {
    bound: DepthBound,
    level_of_mm: Vec<u16>,
    mm_of_level: Vec<u16>,
}

impl Levels {
    /// Computes the tables, which takes 0.2 ms: keep them.
    pub(crate) fn new(bound: DepthBound) -> Self {
        let mut level_of_mm = vec![0; 1 << 16];
        let mut mm_of_level = vec![0];
        let mut low = 1u32;
        while low <= MAX_MM {
            // The bound grows with depth, so the values in between are also within it.
            let centre = (low + u32::from(bound.error_mm(low as u16))).min(MAX_MM);
            let within =
                |mm: u32| mm <= MAX_MM && mm - centre <= u32::from(bound.error_mm(mm as u16));
            let mut end = centre + 1;
            while within(end) {
                end += 1;
            }
            level_of_mm[low as usize..end as usize].fill(mm_of_level.len() as u16);
            mm_of_level.push(centre as u16);
            low = end;
        }
        Self { bound, level_of_mm, mm_of_level }
    }

    /// Returns the tables in `slot`; computes them if they have another bound.
    pub(crate) fn cached(slot: &mut Option<Self>, bound: DepthBound) -> &Self {
        if slot.as_ref().is_none_or(|levels| levels.bound != bound) {
            *slot = None;
        }
        slot.get_or_insert_with(|| Self::new(bound))
    }

    /// Replaces the contents of `out` by the levels of these depths.
    pub(crate) fn round(&self, depth_mm: &[u16], out: &mut Vec<u16>) {
        out.clear();
        out.extend(depth_mm.iter().map(|&mm| self.level_of_mm[usize::from(mm)]));
    }

    /// Replaces levels by their depths; 0 for unknown levels.
    pub(crate) fn restore(&self, levels: &mut [u16]) {
        for level in levels {
            *level = self.mm_of_level.get(usize::from(*level)).copied().unwrap_or(0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_depth_is_within_its_bound_and_validity_is_exact() {
        for k in [1e-6, 1e-4, 0.001, 0.0025, 0.03, 0.1] {
            let bound = DepthBound::new(k).unwrap();
            let levels = Levels::new(bound);
            let mut rounded = Vec::new();
            let all: Vec<u16> = (0..=u16::MAX).collect();
            levels.round(&all, &mut rounded);
            levels.restore(&mut rounded);
            for (&truth, &decoded) in all.iter().zip(&rounded) {
                assert_eq!(truth == 0, decoded == 0);
                let z = f64::from(truth) / 1000.0;
                let allowed = (1000.0 * k * z * z).max(1.0) + 1e-9;
                let error = f64::from(truth.abs_diff(decoded));
                assert!(error <= allowed, "k {k}: {truth} came back as {decoded}");
            }
        }
    }

    #[test]
    fn number_of_levels_and_errors_match_the_documentation() {
        let bound = DepthBound::new(0.001).unwrap();
        assert_eq!(Levels::new(bound).mm_of_level.len(), 816);
        let errors = [0, 1000, 2000, 5000, 65535].map(|mm| bound.error_mm(mm));
        assert_eq!(errors, [1, 1, 4, 25, 4294]);
    }

    #[test]
    fn rejects_bounds_out_of_range() {
        for k in [0.0, -1.0, 1e-7, 0.11, f64::NAN, f64::INFINITY] {
            assert_eq!(DepthBound::new(k), None, "{k}");
        }
        assert_eq!(DepthBound::new(0.001).unwrap().k_per_m(), 0.001);
    }
}
