//! Ambiguity of f32 at cuts. The position of its mean determines whether a splat is rendered: in front of the near
//! plane or behind it, within the reach of the lens or beyond. Within the rounding of f32 of such a cut, a fast
//! renderer may differ from the reference: it renders the complete splat, or omits it.

use glam::{DMat3, DVec3, Vec3};
use vizflyt_protocol::geometry::{Cam, Frame, Pose};
use vizflyt_splat::{Camera, Placement, RgbdImage, Scene, Splats, render_reference};

/// Relative error of one operation in f32.
const ROUNDING: f64 = f32::EPSILON as f64 / 2.0;
/// Fast renderers widen the reach by this share, so that splats exactly at the reach are rendered.
const WIDENED: f64 = 1e-6;
/// Maximum number of splats on cuts, all combinations of which are tried. One random scene in a thousand has one.
const MAX_ON_CUTS: usize = 4;

/// Returns the image of the reference; with splats on a cut, one image for every combination of them.
pub(crate) fn references<'a>(
    scene: impl Into<Scene<'a>>,
    placements: &[Placement],
    camera: &Camera,
) -> Vec<RgbdImage> {
    let scene = scene.into();
    // Part, splat, and the mean with which the reference renders it.
    let mut on_cuts: Vec<(usize, usize, Vec3)> = Vec::new();
    let mut look = |part: usize, splats: &Splats, cuts: &Cuts| {
        let found = (0..splats.len()).filter(|&i| cuts.are_near(splats.means_m[i]));
        on_cuts.extend(found.map(|i| (part, i, cuts.inside(splats.means_m[i]))));
    };
    look(0, scene.splats, &Cuts::new(camera, &camera.world_from_cam));
    for (i, (object, placement)) in scene.objects.iter().zip(placements).enumerate() {
        if let Some(pose) = placement {
            let object_from_cam = pose.inverse() * camera.world_from_cam;
            look(i + 1, &object.splats, &Cuts::new(camera, &object_from_cam));
        }
    }
    assert!(on_cuts.len() <= MAX_ON_CUTS, "{} splats are on a cut", on_cuts.len());
    let choose = |choice: u32| {
        let (mut splats, mut objects) = (scene.splats.clone(), scene.objects.to_vec());
        for (k, &(part, i, inside_m)) in on_cuts.iter().enumerate() {
            let changed = if part == 0 { &mut splats } else { &mut objects[part - 1].splats };
            if choice >> k & 1 == 1 {
                changed.means_m[i] = inside_m;
            } else {
                changed.opacities[i] = 0.0;
            }
        }
        let scene = Scene { splats: &splats, objects: &objects };
        render_reference(scene, placements, camera).expect("a valid camera")
    };
    (0..1 << on_cuts.len()).map(choose).collect()
}

/// Cuts of a camera, relative to one part of the scene.
struct Cuts {
    cam_from_part: DMat3,
    center_m: DVec3,
    near_m: f64,
    reach: f64,
}

impl Cuts {
    fn new<F: Frame>(camera: &Camera, part_from_cam: &Pose<F, Cam>) -> Self {
        Self {
            cam_from_part: DMat3::from_quat(part_from_cam.rotation.normalize()).transpose(),
            center_m: part_from_cam.translation_m,
            near_m: f64::from(camera.near_m),
            reach: camera.intrinsics.distortion.reach(),
        }
    }

    /// Returns camera z [m] and slope of a mean.
    fn place(&self, mean_m: Vec3) -> (f64, f64) {
        let p = self.cam_from_part * (mean_m.as_dvec3() - self.center_m);
        (p.z, p.truncate().length() / p.z)
    }

    /// Returns whether f64 renders a splat with this mean.
    fn show(&self, mean_m: Vec3) -> bool {
        let (z, slope) = self.place(mean_m);
        z > self.near_m && slope <= self.reach
    }

    /// Returns whether the result of f32 may differ.
    fn are_near(&self, mean_m: Vec3) -> bool {
        let (z, slope) = self.place(mean_m);
        // In f32, the camera's centre, the difference, the rotation and three terms are rounded.
        let distance_m = (mean_m.as_dvec3() - self.center_m).length();
        let off_m = ROUNDING * (self.center_m.length() + 5.0 * distance_m);
        // Then the division, product and square of the slope, and the reach.
        let off = (WIDENED + 5.0 * ROUNDING) * slope + off_m * (1.0 + slope) / z;
        z > self.near_m - off_m
            && slope <= self.reach + off
            && (z <= self.near_m + off_m || slope >= self.reach - off)
    }

    /// Returns the mean, or the next point ahead of it that f64 renders: moving forward leaves every cut.
    fn inside(&self, mean_m: Vec3) -> Vec3 {
        let forward = self.cam_from_part.row(2);
        let step_m = ROUNDING * (mean_m.as_dvec3() - self.center_m).length();
        let moved = |step: i32| (mean_m.as_dvec3() + forward * step_m * f64::from(step)).as_vec3();
        (0..1000).map(moved).find(|&mean_m| self.show(mean_m)).expect("a place next to the cut")
    }
}
