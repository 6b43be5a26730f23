//! Bounded error: depth rounded to levels that lie as far apart as the bound allows.
//!
//! The bound grows with the square of depth, as the noise of stereo and time-of-flight cameras
//! does (Khoshelham and Elberink, Sensors 2012, equation 12), so levels are about evenly spaced in
//! inverse depth: a plane in space stays nearly a plane in the image of levels, and the same
//! predictor serves. Both ends build the same table from the header, in integers.

/// How far a decoded depth may be from the true one: `max(1 mm, k z^2)`, z in metres, of the true
/// depth. No return stays no return, and a return stays one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthBound(u32);

impl DepthBound {
    /// Returns the bound with this `k` (0.001: 1 mm at 1 m, 25 mm at 5 m), to the millionth;
    /// `None` unless it is 1e-6 to 0.1. [1/m]
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

    /// Returns k. [1/m]
    pub fn k_per_m(self) -> f64 {
        f64::from(self.0) * 1e-6
    }

    /// Returns how far the depth decoded for this one may be off. [mm]
    pub fn error_mm(self, depth_mm: u16) -> u16 {
        let square = u64::from(depth_mm).pow(2);
        // Below 1 mm it is rounded up to it, else down to a whole one. At most 429484.
        (u64::from(self.0) * square / 1_000_000_000).clamp(1, u64::from(u16::MAX)) as u16
    }
}

/// The largest depth. [mm]
const MAX_MM: u32 = u16::MAX as u32;
/// 0.1: a third of the depth at 3 m. [millionths]
const MAX_MILLIONTHS: u32 = 100_000;

/// Depth to level and back.
#[derive(Clone, Debug)]
pub(crate) struct Levels {
    bound: DepthBound,
    level_of_mm: Vec<u16>,
    mm_of_level: Vec<u16>,
}

impl Levels {
    /// Builds the tables, in 0.2 ms: keep them.
    pub(crate) fn new(bound: DepthBound) -> Self {
        let mut level_of_mm = vec![0; 1 << 16];
        let mut mm_of_level = vec![0];
        let mut low = 1u32;
        while low <= MAX_MM {
            // The bound grows with depth: whatever lies between is within it as well.
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

    /// Returns the tables in `slot` if they are of this bound, else makes them.
    pub(crate) fn cached(slot: &mut Option<Self>, bound: DepthBound) -> &Self {
        if slot.as_ref().is_none_or(|levels| levels.bound != bound) {
            *slot = None;
        }
        slot.get_or_insert_with(|| Self::new(bound))
    }

    /// Writes the levels of these depths to `out`, whose length and contents are replaced.
    pub(crate) fn round(&self, depth_mm: &[u16], out: &mut Vec<u16>) {
        out.clear();
        out.extend(depth_mm.iter().map(|&mm| self.level_of_mm[usize::from(mm)]));
    }

    /// Replaces levels by their depths; 0 for levels that there are none of.
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
    fn levels_are_few_and_the_usual_bound_is_as_documented() {
        let bound = DepthBound::new(0.001).unwrap();
        assert_eq!(Levels::new(bound).mm_of_level.len(), 816);
        let errors = [0, 1000, 2000, 5000, 65535].map(|mm| bound.error_mm(mm));
        assert_eq!(errors, [1, 1, 4, 25, 4294]);
    }

    #[test]
    fn bounds_out_of_range_are_none() {
        for k in [0.0, -1.0, 1e-7, 0.11, f64::NAN, f64::INFINITY] {
            assert_eq!(DepthBound::new(k), None, "{k}");
        }
        assert_eq!(DepthBound::new(0.001).unwrap().k_per_m(), 0.001);
    }
}
