//! Parameters of a phone camera: lens, shutter, sensor.

use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use crate::SceneKind;
use crate::random::Rng;

/// Main camera of a phone during a video.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Phone {
    /// Size, focal lengths, principal point, distortion.
    pub intrinsics: Intrinsics,
    /// Time from the exposure of the first row to that of the last row. [s]
    pub readout_s: f64,
    /// Relative loss of light in the corners; 0.25 leaves 75 %.
    pub vignette: f64,
    /// Illuminance of the place, which determines shutter and noise. [lx]
    pub illuminance_lx: f64,
}

impl Phone {
    /// Draws a phone from a seed: field of view of 62 to 68 degrees, barrel distortion of some pixels in the corners,
    /// and a slightly decentred lens.
    ///
    /// The readout takes 22 ms. Measured values: iPhone 5 22.6 ms at 720x480 and 27 ms at 1080p, older phones about 30
    /// ms (table of rolling shutter parameters of consumer cameras, in a fork of kalibr,
    /// `doc/rolling-shutter-table.md`).
    pub fn draw(kind: SceneKind, seed: u64, width_px: u32, height_px: u32) -> Self {
        let mut rng = Rng::new(seed, 63);
        let fov_rad = rng.range(62.0, 68.0).to_radians();
        // The field of view of phones is stated for the longer side.
        let long_px = width_px.max(height_px);
        let f_px = f64::from(long_px) / 2.0 / libm::tan(fov_rad / 2.0);
        let off = |rng: &mut Rng| rng.spread(0.006) * f64::from(long_px);
        let intrinsics = Intrinsics {
            width_px,
            height_px,
            fx_px: f_px,
            fy_px: f_px * rng.range(0.999, 1.001),
            cx_px: f64::from(width_px) / 2.0 + off(&mut rng),
            cy_px: f64::from(height_px) / 2.0 + off(&mut rng),
            distortion: Distortion::BrownConrady {
                k1: -rng.range(0.04, 0.09),
                k2: rng.range(0.01, 0.04),
                p1: rng.spread(6e-4),
                p2: rng.spread(6e-4),
                k3: 0.0,
            },
        };
        Self { intrinsics, readout_s: 0.022, vignette: 0.25, illuminance_lx: illuminance_lx(kind) }
    }

    /// Returns the middle of the exposure of a row; centres of rows are at +0.5. `middle_s` is that of the image's
    /// middle. [s]
    pub fn row_instant_s(&self, row: f64, middle_s: f64) -> f64 {
        let height = f64::from(self.intrinsics.height_px);
        middle_s + (row / height - 0.5) * self.readout_s
    }

    /// Returns shot and read noise at an ISO. A pixel of linear light `x` has the variance `shot x + read`
    /// (Foi, Trimeche, Katkovnik, Egiazarian, IEEE TIP 2008).
    ///
    /// Shot noise follows from the full-well capacity: about 6000 electrons for a photosite of 1 to 1.4 um at ISO 50,
    /// and a video pixel combines four of them. The relation to read noise was measured on phones: `ln read = 2.18 ln
    /// shot + 1.2` (Brooks et al., Unprocessing Images for Learned Raw Denoising, CVPR 2019, from the Darmstadt
    /// dataset).
    pub fn noise(&self, iso: f64) -> (f64, f64) {
        let shot = iso / LEAST_ISO / FULL_ELECTRONS;
        (shot, libm::exp(2.18 * libm::log(shot) + 1.2))
    }
}

/// Returns the illuminance of a place: an office has 300 to 500 lx (EN 12464-1), the floor of a forest by day some
/// thousands.
fn illuminance_lx(kind: SceneKind) -> f64 {
    match kind {
        SceneKind::Forest => 3000.0,
        SceneKind::Race | SceneKind::Room | SceneKind::Moving => 300.0,
    }
}

/// Minimum ISO of most phones.
pub(super) const LEAST_ISO: f64 = 50.0;
/// Full-well capacity of a video pixel at the minimum ISO. [electrons]
const FULL_ELECTRONS: f64 = 4.0 * 6000.0;
