//! Glare of a low sun: light that a lens scatters over the image.
//!
//! The light scattered at an angle t (degrees) from a source is `10 / t³ + 5 / t²` of its light
//! (CIE 146:2002, disability glare of the eye, without the age term), times a factor for the
//! quality of the lens. The visible share of the sun follows from the rendered image: the sun is
//! visible where there is no surface, or where the surface is farther than a given distance.

use glam::{DVec2, DVec3, Vec3};

use super::cloud::smooth;
use crate::{Camera, RgbdImage};

/// Sun, or any distant lamp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sun {
    /// Unit vector towards the sun. [world]
    pub direction: DVec3,
    /// Scattered light relative to that of an eye. A clean lens scatters less, a wet one more.
    pub glare: f32,
    /// Colour: red, green, blue; 1 is white.
    pub color: [f32; 3],
    /// Distance from which surfaces do not hide the sun, for images of a sky or of the space behind
    /// a window. [m]
    pub behind_m: f32,
}

/// Direction and visible strength of the sun in an image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Glare {
    direction_cam: Vec3,
    /// Strength per channel, in linear light.
    strength: [f32; 3],
}

/// Angular radius of the sun. [deg]
const DISC_DEG: f32 = 0.27;
/// Radius around the sun's centre that is sampled for occlusion, so that a branch of a tree does
/// not switch it off. [rad]
const LOOK_RAD: f64 = 0.02;
/// Range beyond `behind_m` over which surfaces fade to not hiding the sun, as a share of
/// `behind_m`, to avoid an abrupt change.
const FADE: f32 = 0.25;
/// Samples across that area.
const LOOKS: i32 = 9;
/// Range outside the image in which the glare fades, because a hood keeps the sun off the lens.
/// [share of the image]
const OUTSIDE: f64 = 0.25;

impl Glare {
    /// Returns the glare, or `None` if the sun is not visible.
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

    /// Adds the scattered light to a row of pixels.
    pub(super) fn add_to_row(&self, [sx, sy, norm]: [&[f32]; 3], rgb: &mut [f32]) {
        let Vec3 { x, y, z } = self.direction_cam;
        // 2 (1 - cos t) equals t² within 1 % up to 20 degrees, and grows more slowly beyond.
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

/// Returns the share of samples around `center` at which no surface hides the sun.
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
            // The comparison is false for NaN, so NaN hides the sun.
            seen += if open > far { open.min(1.0) } else { far };
        }
    }
    if looked > 0.0 { seen / looked } else { 0.0 }
}
