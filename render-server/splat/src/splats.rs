//! Scene in memory: activated parameters, structure of arrays.

use glam::{Quat, Vec3};

/// 3D Gaussians with spherical-harmonic colour, in metres in the world frame.
///
/// All vectors have the same length [`Self::len`]; `sh` has `sh_coefficients() * 3` numbers each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// Centres. [m, world]
    pub means_m: Vec<Vec3>,
    /// Standard deviations along the axes of the Gaussian (after the exponential). [m]
    pub scales_m: Vec<Vec3>,
    /// Rotation of the Gaussian's axes in the world; unit quaternions.
    pub rotations: Vec<Quat>,
    /// Peak opacity, 0 to 1 (after the sigmoid).
    pub opacities: Vec<f32>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u8,
    /// Coefficients: splat by splat, in each splat coefficient by coefficient from the constant on, in each
    /// coefficient RGB.
    pub sh: Vec<f32>,
    /// Whether the splats were trained with anti-aliasing (mip-splatting; gsplat's `antialiased`, brush's `mip`). The
    /// renderer then dims each splat by the area that the pixel's blur adds. Read from the file if it contains the
    /// setting.
    pub antialiased: bool,
}

impl Splats {
    /// Returns the number of splats.
    pub fn len(&self) -> usize {
        self.means_m.len()
    }

    /// Whether the scene has no splats.
    pub fn is_empty(&self) -> bool {
        self.means_m.is_empty()
    }

    /// Returns the number of coefficients per colour channel: 1, 4, 9 or 16.
    pub fn sh_coefficients(&self) -> usize {
        (usize::from(self.sh_degree) + 1).pow(2)
    }
}
