//! Renders one image: camera in, JPEG out.

use glam::{DVec3, Vec3};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_splat::format::{Format, parse};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

use crate::web::twin::{TwinParts, select};

/// The twin in memory, as sent to pages, and a renderer for the visible splats.
#[derive(Debug)]
pub(super) struct Engine {
    splats: Splats,
    /// Minimum and maximum corner of the fence. [m, world]
    fence_m: [Vec3; 2],
    /// Renderer of the last image, and the sides of the fence that its camera was beyond.
    renderer: Option<(Sides, CpuRenderer)>,
    image: [RgbdImage; 1],
    rgb: Vec<u8>,
}

/// Sides of the fence that a camera is beyond, per axis: -1 minimum, 1 maximum, 0 neither.
type Sides = [i8; 3];

impl Engine {
    /// Reads all parts of a twin.
    ///
    /// # Errors
    /// If a part cannot be read.
    pub(super) fn new(twin: &TwinParts, fence_m: [DVec3; 2]) -> Result<Self, String> {
        let mut splats = Splats::default();
        for part in (0..twin.len()).filter_map(|k| twin.get(k)) {
            let part = parse(&part, Format::Spz).map_err(|error| error.to_string())?.splats;
            splats.means_m.extend(part.means_m);
            splats.scales_m.extend(part.scales_m);
            splats.rotations.extend(part.rotations);
            splats.opacities.extend(part.opacities);
            // Parts contain only the constant colour.
            splats.sh.extend(part.sh);
            splats.antialiased = part.antialiased;
        }
        let fence_m = fence_m.map(DVec3::as_vec3);
        let image = [RgbdImage::default()];
        Ok(Self { splats, fence_m, renderer: None, image, rgb: Vec::new() })
    }

    /// Returns the JPEG of a camera's view. With `cut`, omits splats beyond the sides of the fence that the camera is
    /// beyond.
    ///
    /// # Errors
    /// If the renderer rejects the camera.
    pub(super) fn draw(&mut self, camera: &Camera, cut: bool) -> Result<Vec<u8>, String> {
        let eye_m = camera.world_from_cam.translation_m.as_vec3();
        let sides = if cut { sides(eye_m, self.fence_m) } else { [0; 3] };
        let renderer = self.renderer.take().filter(|(former, _)| *former == sides);
        let (_, renderer) = self.renderer.insert(renderer.unwrap_or_else(|| {
            let kept = |&k: &usize| !is_cut(self.splats.means_m[k], self.fence_m, sides);
            let shown = select(&self.splats, (0..self.splats.len()).filter(kept));
            (sides, CpuRenderer::new(&shown))
        }));
        let drawn = renderer.render(&[], &[*camera], &mut self.image);
        drawn.map_err(|error| error.to_string())?;
        let [image] = &self.image;
        image.write_rgb8(&mut self.rgb);
        let mut jpeg = Vec::new();
        encode_jpeg(&self.rgb, image.width_px, image.height_px, QUALITY, &mut jpeg)
            .map_err(|error| error.to_string())?;
        Ok(jpeg)
    }
}

fn sides(eye_m: Vec3, [min_m, max_m]: [Vec3; 2]) -> Sides {
    [0, 1, 2].map(|axis| i8::from(eye_m[axis] > max_m[axis]) - i8::from(eye_m[axis] < min_m[axis]))
}

/// Whether a splat's centre is beyond one of these sides.
fn is_cut(mean_m: Vec3, fence_m: [Vec3; 2], beyond: Sides) -> bool {
    let own = sides(mean_m, fence_m);
    (0..3).any(|axis| beyond[axis] != 0 && own[axis] == beyond[axis])
}

/// As for the camera images on the page.
const QUALITY: u8 = 80;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::twin_picture::tests::{camera, wall};
    use vizflyt_protocol::geometry::Pose;

    /// Returns the centre pixel of the last image.
    fn middle(engine: &Engine) -> [u8; 3] {
        let [image] = &engine.image;
        let at = 3 * (image.rgb.len() / 3 / 2 + image.width_px as usize / 2);
        engine.rgb[at..at + 3].try_into().unwrap()
    }

    #[test]
    fn renders_the_scene_ahead_of_the_camera() {
        let half_m = DVec3::splat(5.0);
        let twin = TwinParts::choose(&wall(), -half_m, half_m);
        let mut engine = Engine::new(&twin, [-half_m, half_m]).unwrap();
        let jpeg = engine.draw(&camera(), false).unwrap();
        assert_eq!(jpeg[..2], [0xff, 0xd8]);
        let [red, green, blue] = middle(&engine);
        assert!(red > 200 && green < 60 && blue < 60, "{red} {green} {blue}");
        // Turned around: only the background.
        let about = glam::DQuat::from_rotation_y(std::f64::consts::PI);
        let away = Camera { world_from_cam: Pose::new(DVec3::ZERO, about), ..camera() };
        let away = Camera { background: [0.0, 1.0, 0.0], ..away };
        engine.draw(&away, false).unwrap();
        assert_eq!(middle(&engine), [0, 255, 0]);
        let lost =
            Camera { world_from_cam: Pose::new(DVec3::NAN, glam::DQuat::IDENTITY), ..camera() };
        assert!(engine.draw(&lost, false).is_err());
    }

    #[test]
    fn a_camera_outside_does_not_see_the_near_side_of_the_fence() {
        // The wall at z = 3 is just outside a fence that ends at z = 2; the camera looks in from beyond it.
        let (min_m, max_m) = (DVec3::splat(-2.0), DVec3::splat(2.0));
        let twin = TwinParts::choose(&wall(), min_m, max_m);
        let mut engine = Engine::new(&twin, [min_m, max_m]).unwrap();
        let about = glam::DQuat::from_rotation_y(std::f64::consts::PI);
        let from = |z_m| Pose::new(DVec3::Z * z_m, about);
        let outside = Camera { world_from_cam: from(6.0), ..camera() };
        let red = |engine: &mut Engine, camera: &Camera, cut| {
            engine.draw(camera, cut).unwrap();
            middle(engine)[0] > 200
        };
        assert!(red(&mut engine, &outside, false) && !red(&mut engine, &outside, true));
        // From the other side it is the far wall, and stays; from inside nothing is omitted.
        let ahead = Pose::new(DVec3::Z * -6.0, glam::DQuat::IDENTITY);
        assert!(red(&mut engine, &Camera { world_from_cam: ahead, ..camera() }, true));
        assert!(red(&mut engine, &camera(), true));
    }

    #[test]
    fn splats_inside_the_fence_are_never_cut() {
        let fence = [Vec3::splat(-1.0), Vec3::splat(1.0)];
        assert_eq!(sides(Vec3::new(-2.0, 0.0, 3.0), fence), [-1, 0, 1]);
        assert!(is_cut(Vec3::new(-1.5, 0.0, 0.0), fence, [-1, 0, 1]));
        assert!(!is_cut(Vec3::new(1.5, 9.0, -9.0), fence, [-1, 0, 1]));
        assert!(!is_cut(Vec3::ZERO, fence, [-1, 1, 1]));
    }
}
