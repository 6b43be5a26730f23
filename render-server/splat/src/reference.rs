//! Reference renderer, to which all fast renderers must agree. Simple, in f64, and slow on purpose.
//!
//! Classic 3D Gaussian splatting (Kerbl et al. 2023, section 4 and appendix A). Each Gaussian is linearised at its
//! centre, `J W Sigma W^T J^T + 0.3 I`. Splats are blended from near to far, by camera z. A pixel takes a splat if
//! `alpha = min(0.99, o exp(-sigma)) >= 1/255`, and ends *before* the splat that would reduce its transmittance to
//! 1e-4 or below.

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Frame, Pose};

use crate::harmonics;
use crate::limits::{ALPHA_MAX, ALPHA_MIN, BLUR_PX2, MAX_SCALE_M, TRANSMITTANCE_MIN};
use crate::rasterizer::{self, RenderError};
use crate::{Camera, Placement, RgbdImage, Scene, Splats};

/// Renders a scene with placed objects: RGB on the background, alpha, expected and median camera-z depth [m, cam],
/// ids.
///
/// # Errors
/// [`RenderError`] if the camera or a placement is invalid.
///
/// # Panics
/// If the number of placements differs from that of the objects.
pub fn render_reference<'a>(
    scene: impl Into<Scene<'a>>,
    placements: &[Placement],
    camera: &Camera,
) -> Result<RgbdImage, RenderError> {
    let scene = scene.into();
    let mut image = RgbdImage::default();
    rasterizer::validate(
        scene.objects.len(),
        placements,
        std::slice::from_ref(camera),
        std::slice::from_ref(&image),
    )?;
    let lens = Lens::new(camera);
    let mut projected = Vec::new();
    let mut add = |splats: &Splats, id: u16, camera_in_scene: CameraInScene| {
        let all = 0..splats.len();
        projected
            .extend(all.filter_map(|i| project(splats, i, id, &camera_in_scene, &lens, camera)));
    };
    add(scene.splats, 0, CameraInScene::from(&camera.world_from_cam));
    for (object, placement) in scene.objects.iter().zip(placements) {
        if let Some(world_from_object) = placement {
            // A moving object before a camera is the same as a static object before a moving camera.
            let object_from_cam = world_from_object.inverse() * camera.world_from_cam;
            add(&object.splats, object.id, CameraInScene::from(&object_from_cam));
        }
    }
    projected.sort_by(|a, b| a.z_m.total_cmp(&b.z_m));
    blend(&projected, camera, &mut image);
    Ok(image)
}

/// Pose of the camera relative to a part of the scene.
struct CameraInScene {
    rotation: DMat3,
    center_m: DVec3,
}

impl<F: Frame> From<&Pose<F, Cam>> for CameraInScene {
    fn from(part_from_cam: &Pose<F, Cam>) -> Self {
        let rotation = DMat3::from_quat(part_from_cam.rotation.normalize()).transpose();
        Self { rotation, center_m: part_from_cam.translation_m }
    }
}

/// Values of the lens that are computed once per camera.
struct Lens {
    slopes: [DVec2; 2],
    reach: f64,
}

impl Lens {
    fn new(camera: &Camera) -> Self {
        Self { slopes: camera.slope_bounds(), reach: camera.intrinsics.distortion.reach() }
    }
}

/// Gaussian on the image plane.
struct Projected {
    mean_px: DVec2,
    /// Inverse covariance: xx, xy, yy. [1/px^2]
    conic: [f64; 3],
    /// Half of the bounding box of the ellipse `alpha >= 1/255`. [px]
    extent_px: DVec2,
    z_m: f64,
    id: u16,
    opacity: f64,
    rgb: DVec3,
}

/// Projects one splat; returns `None` if it cannot touch the image.
fn project(
    splats: &Splats,
    i: usize,
    id: u16,
    camera_in_scene: &CameraInScene,
    lens: &Lens,
    camera: &Camera,
) -> Option<Projected> {
    let k = &camera.intrinsics;
    let mean = splats.means_m[i].as_dvec3();
    let p_cam = camera_in_scene.rotation * (mean - camera_in_scene.center_m);
    let slope = p_cam.truncate() / p_cam.z;
    // Written so that NaN is rejected.
    if !(p_cam.z > f64::from(camera.near_m) && slope.length() <= lens.reach) {
        return None;
    }
    let focal = DVec2::new(k.fx_px, k.fy_px);
    let mean_px = focal * k.distortion.distort(slope).0 + DVec2::new(k.cx_px, k.cy_px);

    // The linearisation diverges outside the image: it is taken at the nearest slope within the bounds.
    let at = slope.clamp(lens.slopes[0], lens.slopes[1]).clamp_length_max(lens.reach);
    let (_, bend) = k.distortion.distort(at);

    let scale_m = splats.scales_m[i].as_dvec3().min(DVec3::splat(f64::from(MAX_SCALE_M)));
    let q = splats.rotations[i].as_dquat();
    let axes = DMat3::from_quat(DQuat::normalize(q)) * DMat3::from_diagonal(scale_m);
    // Rows of J W M: covariance = B B^T.
    let in_cam = (camera_in_scene.rotation * axes).transpose();
    let pinhole_x = (in_cam.x_axis - at.x * in_cam.z_axis) / p_cam.z;
    let pinhole_y = (in_cam.y_axis - at.y * in_cam.z_axis) / p_cam.z;
    let row_x = focal.x * (bend.x_axis.x * pinhole_x + bend.y_axis.x * pinhole_y);
    let row_y = focal.y * (bend.x_axis.y * pinhole_x + bend.y_axis.y * pinhole_y);
    let a = row_x.dot(row_x) + BLUR_PX2;
    let b = row_x.dot(row_y);
    let c = row_y.dot(row_y) + BLUR_PX2;
    let determinant = a * c - b * b;

    // alpha >= 1/255 where sigma <= ln(255 o): the bounding box of that ellipse.
    let opacity = f64::from(splats.opacities[i])
        * if splats.antialiased { unblurred(&row_x, &row_y, determinant) } else { 1.0 };
    let reach = 2.0 * (opacity / ALPHA_MIN).ln();
    if !(determinant > 0.0 && reach >= 0.0) {
        return None;
    }
    let extent_px = DVec2::new((reach * a).sqrt(), (reach * c).sqrt());
    let (w, h) = (f64::from(k.width_px), f64::from(k.height_px));
    let touches = mean_px.x + extent_px.x > 0.0
        && mean_px.x - extent_px.x < w
        && mean_px.y + extent_px.y > 0.0
        && mean_px.y - extent_px.y < h;
    if !touches {
        return None;
    }
    let direction = (mean - camera_in_scene.center_m).normalize_or(DVec3::Z);
    let numbers = splats.sh_coefficients() * 3;
    let sh = &splats.sh[i * numbers..(i + 1) * numbers];
    let rgb = harmonics::colour(sh, direction.to_array());
    let rgb = camera.atmosphere.attenuate(rgb, (mean - camera_in_scene.center_m).length());
    Some(Projected {
        mean_px,
        conic: [c / determinant, -b / determinant, a / determinant],
        extent_px,
        z_m: p_cam.z,
        id,
        opacity,
        rgb: DVec3::from(rgb),
    })
}

/// Returns the factor that dims an anti-aliased splat, so that the pixel's blur does not add to its covered area: the
/// square root of the covariance's determinant without blur, divided by that with blur. (Yu et al. 2024,
/// "Mip-Splatting", equation 10; the compensation of gsplat's `rasterize_mode="antialiased"`.)
fn unblurred(row_x: &DVec3, row_y: &DVec3, determinant: f64) -> f64 {
    // Cauchy-Binet: the sum of squared minors, never below 0.
    (row_x.cross(*row_y).length_squared() / determinant).sqrt()
}

/// Blends splats from near to far.
fn blend(projected: &[Projected], camera: &Camera, image: &mut RgbdImage) {
    let k = &camera.intrinsics;
    let (width, height) = (k.width_px as usize, k.height_px as usize);
    let pixels = k.pixels();
    let mut rgb = vec![DVec3::ZERO; pixels];
    let mut transmittance = vec![1f64; pixels];
    let mut weighted_z = vec![0f64; pixels];
    let mut median_m = vec![0f64; pixels];
    let mut ids = vec![0u16; pixels];
    let mut ended = vec![false; pixels];
    for splat in projected {
        let range = |centre: f64, extent: f64, size: usize| {
            let first = (centre - extent).floor().clamp(0.0, size as f64) as usize;
            first..((centre + extent).ceil() + 1.0).clamp(0.0, size as f64) as usize
        };
        for y in range(splat.mean_px.y, splat.extent_px.y, height) {
            for x in range(splat.mean_px.x, splat.extent_px.x, width) {
                let i = y * width + x;
                if ended[i] {
                    continue;
                }
                let d = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - splat.mean_px;
                let [xx, xy, yy] = splat.conic;
                let sigma = 0.5 * (xx * d.x * d.x + yy * d.y * d.y) + xy * d.x * d.y;
                let alpha = (splat.opacity * (-sigma).exp()).min(ALPHA_MAX);
                if !(alpha >= ALPHA_MIN && sigma >= 0.0) {
                    continue;
                }
                let before = transmittance[i];
                let after = before * (1.0 - alpha);
                if after <= TRANSMITTANCE_MIN {
                    ended[i] = true;
                    continue;
                }
                rgb[i] += splat.rgb * (alpha * before);
                weighted_z[i] += splat.z_m * alpha * before;
                if before > 0.5 && after <= 0.5 {
                    median_m[i] = splat.z_m;
                    ids[i] = splat.id;
                }
                transmittance[i] = after;
            }
        }
    }
    let background =
        DVec3::from_array(camera.atmosphere.background(camera.background).map(f64::from));
    image.resize(k.width_px, k.height_px);
    for i in 0..pixels {
        let colour = rgb[i] + transmittance[i] * background;
        let alpha = 1.0 - transmittance[i];
        image.rgb[i * 3..i * 3 + 3].copy_from_slice(&colour.as_vec3().to_array());
        image.alpha[i] = alpha as f32;
        image.depth_expected_m[i] = if alpha > 0.0 { (weighted_z[i] / alpha) as f32 } else { 0.0 };
        image.depth_median_m[i] = median_m[i] as f32;
    }
    image.ids = ids;
}
