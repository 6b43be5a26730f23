//! The phone: its lens, its shutter, its sensor.

use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use crate::SceneKind;
use crate::random::Rng;

/// A phone's main camera while it films.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Phone {
    /// Size, focal lengths, principal point, lens.
    pub intrinsics: Intrinsics,
    /// From the first row's exposure to the last one's. [s]
    pub readout_s: f64,
    /// How much darker the corners are than the middle; 0.25 leaves 75 %.
    pub vignette: f64,
    /// How bright the place is: what the shutter and the noise follow from. [lx]
    pub illuminance_lx: f64,
}

impl Phone {
    /// Returns a phone as seeds differ: 62 to 68 degrees across, a barrel of some pixels in the corners, a lens a little off the
    /// middle.
    ///
    /// A readout of 22 ms: of measured phones an iPhone 5 takes 22.6 ms at 720x480, 27 ms at 1080p; older ones about 30 ms
    /// (table of rolling shutter parameters of consumer cameras, in a fork of kalibr, `doc/rolling-shutter-table.md`).
    pub fn draw(kind: SceneKind, seed: u64, width_px: u32, height_px: u32) -> Self {
        let mut rng = Rng::new(seed, 63);
        let fov_rad = rng.range(62.0, 68.0).to_radians();
        // Across the longer side, as a phone's is stated.
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

    /// Returns when a row, whose middle lies at +0.5, is in the middle of its exposure, if the image's middle is at
    /// `middle_s`. [s]
    pub fn row_instant_s(&self, row: f64, middle_s: f64) -> f64 {
        let height = f64::from(self.intrinsics.height_px);
        middle_s + (row / height - 0.5) * self.readout_s
    }

    /// Returns shot and read noise at an ISO: a pixel of linear light `x` has the variance `shot x + read`
    /// (Foi, Trimeche, Katkovnik, Egiazarian, IEEE TIP 2008).
    ///
    /// Shot noise follows from the electrons of a full pixel: about 6000 of a photosite of 1 to 1.4 um at ISO 50, of which a video's
    /// pixel joins four. Read noise goes with it as measured on phones: `ln read = 2.18 ln shot + 1.2` (Brooks et al.,
    /// Unprocessing Images for Learned Raw Denoising, CVPR 2019, from the Darmstadt dataset).
    pub fn noise(&self, iso: f64) -> (f64, f64) {
        let shot = iso / LEAST_ISO / FULL_ELECTRONS;
        (shot, libm::exp(2.18 * libm::log(shot) + 1.2))
    }
}

/// As lit rooms and forests are: an office has 300 to 500 lx (EN 12464-1), a forest's floor by day some thousands.
fn illuminance_lx(kind: SceneKind) -> f64 {
    match kind {
        SceneKind::Forest => 3000.0,
        SceneKind::Race | SceneKind::Room | SceneKind::Moving => 300.0,
    }
}

/// Of most phones' sensors.
pub(super) const LEAST_ISO: f64 = 50.0;
/// Electrons of a full pixel of the video at the least ISO.
const FULL_ELECTRONS: f64 = 4.0 * 6000.0;
