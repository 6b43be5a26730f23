//! A low sun: the light that a lens scatters over the image where the sun shines into it.
//!
//! Scattered light at an angle t (degrees) from a source is `10 / t³ + 5 / t²` of its light (CIE 146:2002, disability
//! glare of the eye, without age), times how much worse or better the lens is. How much of the sun is seen follows
//! from what is rendered: it shines where nothing is, and where nothing is nearer than it.

use glam::{DVec2, DVec3, Vec3};

use super::cloud::smooth;
use crate::{Camera, RgbdImage};

/// The sun, or any lamp far away.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sun {
    /// Where it is, of length 1. [world]
    pub direction: DVec3,
    /// Light that is scattered, against an eye's; a clean lens scatters less, a wet one more.
    pub glare: f32,
    /// Its colour: red, green, blue; 1 is white.
    pub color: [f32; 3],
    /// What is this far away hides it not: the picture of a sky, or of what lies behind a window. [m]
    pub behind_m: f32,
}

/// Where it stands in an image, and how much of it is seen.
#[derive(Clone, Copy, Debug)]
pub(super) struct Glare {
    direction_cam: Vec3,
    /// Per channel, as light.
    strength: [f32; 3],
}

/// Half of the sun's width in the sky. [deg]
const DISC_DEG: f32 = 0.27;
/// Light is looked for this far from the sun's middle: a tree's branch does not switch it off. [rad]
const LOOK_RAD: f64 = 0.02;
/// What is this much farther than `behind_m` hides nothing at all: the sun does not go out at once.
const FADE: f32 = 0.25;
/// Looked at across that.
const LOOKS: i32 = 9;
/// It fades this far outside of the image: a hood keeps it from the lens. [share of the image]
const OUTSIDE: f64 = 0.25;

impl Glare {
    /// Returns nothing where the sun is not seen.
    pub(super) fn of(sun: &Sun, camera: &Camera, image: &RgbdImage) -> Option<Self> {
        let k = &camera.intrinsics;
        let direction_cam = camera.world_from_cam.rotation.inverse() * sun.direction;
        let at_px = k.project(direction_cam)?;
        let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
        let inside = at_px.clamp(DVec2::splat(0.5), size - 0.5);
        let outside = ((at_px - inside) / size).abs().max_element();
        let seen = seen_at(inside, sun.behind_m, LOOK_RAD * k.fx_px, image);
        let share = seen * (1.0 - outside / OUTSIDE).max(0.0) as f32;
        let strength = sun.color.map(|color| color * sun.glare * share);
        (share > 0.0).then(|| Self { direction_cam: direction_cam.as_vec3(), strength })
    }

    /// Adds its light to a row of pixels.
    pub(super) fn add_to_row(&self, [sx, sy, norm]: [&[f32]; 3], rgb: &mut [f32]) {
        let Vec3 { x, y, z } = self.direction_cam;
        // 2 (1 - cos t) is the square of t within 1 % up to 20 degrees, and grows slower beyond.
        let deg2 = 2.0 * (180.0 / std::f32::consts::PI) * (180.0 / std::f32::consts::PI);
        for (((&sx, &sy), &norm), rgb) in sx.iter().zip(sy).zip(norm).zip(rgb.chunks_exact_mut(3)) {
            let cos = (sx * x + sy * y + z) / norm;
            let square = (deg2 * (1.0 - cos)).max(DISC_DEG * DISC_DEG);
            let scattered = (10.0 / square.sqrt() + 5.0) / square;
            for c in 0..3 {
                let value = rgb[c];
                let light = value * value.abs() + self.strength[c] * scattered;
                rgb[c] = if light > 0.0 { light.sqrt() } else { value };
            }
        }
    }
}

/// Returns the share of places around one at which nothing hides the sun.
fn seen_at(center: DVec2, behind_m: f32, half_px: f64, image: &RgbdImage) -> f32 {
    let (width, height) = (i64::from(image.width_px), i64::from(image.height_px));
    let (mut seen, mut looked) = (0.0, 0.0);
    for down in 0..LOOKS {
        for across in 0..LOOKS {
            let offset =
                DVec2::new(f64::from(across), f64::from(down)) * (2.0 / f64::from(LOOKS - 1)) - 1.0;
            let at = center + offset * half_px;
            let (x, y) = (at.x.floor() as i64, at.y.floor() as i64);
            if !(0..width).contains(&x) || !(0..height).contains(&y) {
                continue;
            }
            let pixel = (y * width + x) as usize;
            looked += 1.0;
            let far = smooth((image.depth_median_m[pixel] / behind_m - 1.0) / FADE);
            let open = 1.0 - image.alpha[pixel];
            // Positive, so that what is no number hides it.
            seen += if open > far { open.min(1.0) } else { far };
        }
    }
    if looked > 0.0 { seen / looked } else { 0.0 }
}
