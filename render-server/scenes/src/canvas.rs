//! Canvas for painting scenes: flat Gaussians on surfaces, in linear light, converted to the display colours of splats.

use std::sync::OnceLock;

use glam::{DMat3, DQuat, DVec3};
use vizflyt_splat::Splats;

/// Gaussian patch of a surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Patch {
    /// Centre. [m, world]
    pub(crate) center_m: DVec3,
    /// Direction away from the surface; any length.
    pub(crate) normal: DVec3,
    /// Direction of `sigma_m.x`; made perpendicular to the normal.
    pub(crate) along: DVec3,
    /// Standard deviations along the patch, across it, and along the normal. [m]
    pub(crate) sigma_m: DVec3,
    /// Peak opacity.
    pub(crate) opacity: f64,
    /// Linear light that leaves the patch; 1: white paper in the sun.
    pub(crate) radiance: DVec3,
}

/// Collects patches into [`Splats`] of SH degree 0.
#[derive(Debug, Default)]
pub(crate) struct Canvas {
    splats: Splats,
}

impl Canvas {
    pub(crate) fn add(&mut self, patch: Patch) {
        let normal = patch.normal.normalize_or(DVec3::Z);
        let flat = patch.along - normal * patch.along.dot(normal);
        let along = flat.normalize_or(normal.any_orthonormal_vector());
        let axes = DMat3::from_cols(along, normal.cross(along), normal);
        let rotation = DQuat::from_mat3(&axes).normalize();
        self.splats.means_m.push(patch.center_m.as_vec3());
        self.splats.scales_m.push(patch.sigma_m.max(DVec3::splat(5e-4)).as_vec3());
        self.splats.rotations.push(rotation.as_quat());
        self.splats.opacities.push(patch.opacity.clamp(0.0, 0.99) as f32);
        let display = display_from_linear(patch.radiance);
        self.splats.sh.extend(((display - 0.5) / SH_CONSTANT).as_vec3().to_array());
    }

    /// Returns the number of patches.
    pub(crate) fn len(&self) -> usize {
        self.splats.len()
    }

    /// Returns the splats.
    pub(crate) fn finish(self) -> Splats {
        self.splats
    }
}

/// Returns the linear light of a display colour `0xRRGGBB`.
pub(crate) fn paint(rgb: u32) -> DVec3 {
    // Textures call this a million times, so the inverse sRGB transfer is a table.
    static LINEAR: OnceLock<[f64; 256]> = OnceLock::new();
    let linear = LINEAR.get_or_init(|| {
        core::array::from_fn(|n| {
            let v = n as f64 / 255.0;
            if v <= 0.04045 { v / 12.92 } else { libm::pow((v + 0.055) / 1.055, 2.4) }
        })
    });
    let channel = |shift: u32| linear[((rgb >> shift) & 0xff) as usize];
    DVec3::new(channel(16), channel(8), channel(0))
}

/// Returns the display colour (sRGB, 0 to 1) of linear light: a filmic shoulder, so that sunlit surfaces keep their
/// hue, then the sRGB transfer (IEC 61966-2-1).
fn display_from_linear(radiance: DVec3) -> DVec3 {
    let channel = |light: f64| {
        let x = light.max(0.0);
        // Linear to 0.6, then an exponential approach to 1 with a continuous slope.
        let v = if x <= 0.6 { x } else { 1.0 - 0.4 * libm::exp(-(x - 0.6) / 0.4) };
        if v <= 0.0031308 { 12.92 * v } else { 1.055 * libm::pow(v, 1.0 / 2.4) - 0.055 }
    };
    DVec3::new(channel(radiance.x), channel(radiance.y), channel(radiance.z))
}

/// Constant spherical harmonic, 1 / (2 sqrt(pi)).
const SH_CONSTANT: f64 = 0.282_094_791_773_878_14;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_below_the_shoulder_survive_a_round_trip() {
        for rgb in [0x000000, 0x204060, 0x7f7f7f, 0xb0a090] {
            let shown = display_from_linear(paint(rgb)) * 255.0;
            let back = DVec3::new(
                f64::from(rgb >> 16),
                f64::from((rgb >> 8) & 0xff),
                f64::from(rgb & 0xff),
            );
            assert!((shown - back).abs().max_element() < 0.01, "{rgb:06x} became {shown}");
        }
        let bright = display_from_linear(DVec3::splat(50.0));
        assert!(bright.max_element() <= 1.0);
    }

    #[test]
    fn a_patch_is_thin_along_its_normal() {
        let mut canvas = Canvas::default();
        let normal = DVec3::new(1.0, 2.0, -0.5).normalize();
        canvas.add(Patch {
            center_m: DVec3::ZERO,
            normal,
            along: DVec3::X,
            sigma_m: DVec3::new(0.1, 0.05, 0.002),
            opacity: 0.9,
            radiance: DVec3::ONE,
        });
        let splats = canvas.finish();
        let thin = splats.rotations[0] * glam::Vec3::Z;
        assert!((thin.as_dvec3() - normal).length() < 1e-6);
        let long = splats.rotations[0] * glam::Vec3::X;
        assert!(long.as_dvec3().dot(DVec3::X) > 0.8, "the long side follows `along`");
    }
}
