//! Positions in images: corners of a checkerboard and single dots against the projection formula, to 0.05 px, through
//! pinholes and lenses; and a stereo pair in front of a wall.

use glam::{DMat2, DQuat, DVec2, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};
use vizflyt_splat::{Atmosphere, Camera, Rasterizer, RgbdImage, Scene, Splats};

use crate::renderers;

/// Maximum error. [px]
const LIMIT_PX: f64 = 0.05;
/// Squares of a board, horizontally and vertically.
const SQUARES: [i32; 2] = [8, 6];
/// Side of a square. [m]
const SIDE_M: f64 = 0.13;
/// Splats along a side of a square.
const FINENESS: i32 = 10;

fn add(splats: &mut Splats, at: DVec3, scale_m: Vec3, rotation: DQuat, opacity: f32) {
    splats.means_m.push(at.as_vec3());
    splats.scales_m.push(scale_m);
    splats.rotations.push(rotation.as_quat());
    splats.opacities.push(opacity);
    splats.sh.extend([1.7; 3]);
}

/// Returns the poses of the boards, 2 m from the origin: in front of a camera that looks along z, to its right, and
/// far to its left.
fn boards() -> [Pose<World, World>; 3] {
    [(0.0, 0.1), (-0.75, -0.2), (1.25, 0.15)].map(|(turn, tilt)| {
        let rotation = DQuat::from_rotation_y(-turn) * DQuat::from_rotation_x(tilt);
        Pose::new(rotation * DVec3::new(0.0, 0.0, 2.0), rotation)
    })
}

/// Returns three checkerboards: white squares of splats, without the black ones. A corner is where two white squares
/// meet; it is the point of symmetry, even if their edges are soft.
pub(crate) fn scene() -> Splats {
    let mut splats = Splats::default();
    for world_from_board in boards() {
        for row in 0..SQUARES[1] {
            for column in (row % 2..SQUARES[0]).step_by(2) {
                for i in 0..FINENESS * FINENESS {
                    let (u, v) = (i % FINENESS, i / FINENESS);
                    let along = |square: i32, part: i32, squares: i32| {
                        let part = (f64::from(part) + 0.5) / f64::from(FINENESS);
                        (f64::from(square) + part - 0.5 * f64::from(squares)) * SIDE_M
                    };
                    let at =
                        DVec3::new(along(column, u, SQUARES[0]), along(row, v, SQUARES[1]), 0.0);
                    let size_m = (0.6 * SIDE_M / f64::from(FINENESS)) as f32;
                    let scale_m = Vec3::new(size_m, size_m, 1e-4);
                    let at = world_from_board.transform_point(at);
                    add(&mut splats, at, scale_m, world_from_board.rotation, 0.9);
                }
            }
        }
    }
    splats
}

/// Returns the inner corners of the boards. [m, world]
fn corners() -> Vec<DVec3> {
    let mut corners = Vec::new();
    for world_from_board in boards() {
        for row in 1..SQUARES[1] {
            for column in 1..SQUARES[0] {
                let [x, y] = [(column, SQUARES[0]), (row, SQUARES[1])]
                    .map(|(k, squares)| (f64::from(k) - 0.5 * f64::from(squares)) * SIDE_M);
                corners.push(world_from_board.transform_point(DVec3::new(x, y, 0.0)));
            }
        }
    }
    corners
}

/// Returns the position of the corner near `start`: the saddle of the alpha, found by Newton's method. The alpha is
/// smoothed by a Gaussian, so that it has derivatives everywhere. [px]
fn saddle(image: &RgbdImage, start: DVec2) -> DVec2 {
    const SIGMA_PX: f64 = 1.5;
    const HALF: i32 = 6;
    let mut corner = start;
    for _ in 0..10 {
        let (left, top) = (corner.x.floor() as i32 - HALF, corner.y.floor() as i32 - HALF);
        let (mut gradient, mut hessian) = (DVec2::ZERO, DMat2::ZERO);
        for y in top..=top + 2 * HALF {
            for x in left..=left + 2 * HALF {
                // Derivatives of the Gaussian about the corner, times sigma, times sigma^2.
                let d = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - corner;
                let d = d / SIGMA_PX;
                let alpha = f64::from(image.alpha[(y * image.width_px as i32 + x) as usize]);
                let weight = alpha * (-0.5 * d.length_squared()).exp();
                gradient += weight * d;
                hessian += weight * (DMat2::from_cols(d * d.x, d * d.y) - DMat2::IDENTITY);
            }
        }
        corner -= hessian.inverse() * gradient * SIGMA_PX;
    }
    corner
}

/// Returns lenses and poses of cameras that see the boards; 640 px wide.
fn cameras() -> Vec<(&'static str, Camera)> {
    let pinhole = Intrinsics {
        fy_px: 520.0,
        cx_px: 281.3,
        cy_px: 262.9,
        ..Intrinsics::from_horizontal_fov(640, 480, 64f64.to_radians())
    };
    let brown = Distortion::BrownConrady { k1: -0.28, k2: 0.07, p1: 0.0012, p2: -0.0008, k3: 0.01 };
    let pincushion =
        Distortion::BrownConrady { k1: 0.12, k2: 0.01, p1: -0.001, p2: 0.002, k3: 0.0 };
    let fisheye = Intrinsics {
        fx_px: 300.0,
        fy_px: 299.0,
        cx_px: 325.5,
        cy_px: 236.25,
        distortion: Distortion::KannalaBrandt { k1: 0.02, k2: -0.004, k3: 0.001, k4: -0.0001 },
        ..pinhole
    };
    let lenses = [
        ("pinhole", pinhole),
        ("barrel", Intrinsics { distortion: brown, fx_px: 400.0, fy_px: 402.0, ..pinhole }),
        ("pincushion", Intrinsics { distortion: pincushion, ..pinhole }),
        ("fisheye", fisheye),
    ];
    let mountings: [(DVec3, DQuat); 3] = [
        (DVec3::ZERO, DQuat::IDENTITY),
        (DVec3::new(0.3, -0.1, 0.6), DQuat::from_rotation_y(-0.2) * DQuat::from_rotation_z(0.5)),
        (DVec3::new(-0.4, 0.2, -0.3), DQuat::from_euler(glam::EulerRot::XYZ, 0.3, 0.4, -1.2)),
    ];
    let mut cameras = Vec::new();
    for (name, intrinsics) in lenses {
        for (position_m, rotation) in mountings {
            let world_from_cam = Pose::new(position_m, rotation);
            let camera = Camera::new(intrinsics, world_from_cam, 0.05);
            cameras.push((name, camera));
        }
    }
    cameras
}

/// Returns the image of a point by the formula, if it is at least `margin_px` within the image.
fn lands(camera: &Camera, p_world: DVec3, margin_px: f64) -> Option<DVec2> {
    let k = &camera.intrinsics;
    let pixel = k.project(camera.world_from_cam.inverse().transform_point(p_world))?;
    let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
    let inside = pixel.cmpgt(DVec2::splat(margin_px)).all() && pixel.cmplt(size - margin_px).all();
    inside.then_some(pixel)
}

/// Checks that every corner of [`scene`] is where [`Intrinsics::project`] predicts it.
pub(crate) fn check_corners(renderer: &mut dyn Rasterizer) {
    for (lens, camera) in cameras() {
        let mut image = [RgbdImage::default()];
        renderer.render(&[], &[camera], &mut image).expect("a valid camera");
        let (mut worst_px, mut seen) = (0f64, 0);
        for corner in corners() {
            let Some(expected) = lands(&camera, corner, 8.0) else { continue };
            // Squares must be larger than the window in which the corner is searched.
            let beside = DVec3::new(0.0, SIDE_M, 0.0);
            let next = lands(&camera, corner + beside, 0.0);
            if next.is_none_or(|next| (next - expected).length() < 13.0) {
                continue;
            }
            let off_axis = camera.world_from_cam.inverse().transform_point(corner);
            if off_axis.truncate().length() > 3.0 * off_axis.z {
                // On a board seen at such a steep angle, corners are not square; dots cover larger angles.
                continue;
            }
            worst_px = worst_px.max((saddle(&image[0], expected) - expected).length());
            seen += 1;
        }
        println!("{}, {lens}: {seen} corners, worst off by {worst_px:.4} px", renderer.name());
        assert!(seen >= 12, "{}, {lens}: only {seen} corners", renderer.name());
        assert!(worst_px <= LIMIT_PX, "{}, {lens}: {worst_px} px", renderer.name());
    }
}

/// Returns dots in all directions up to `MAX_DEG` from the z axis, 1 to 9 m away, each some pixels wide for a lens of
/// `px_per_rad`. Their distances are many times larger.
fn dots(px_per_rad: f64) -> Splats {
    const MAX_DEG: i32 = 84;
    let mut splats = Splats::default();
    for ring in (0..=MAX_DEG).step_by(6) {
        let angle = f64::from(ring).to_radians();
        let count = (angle.sin() * 40.0) as i32 + 1;
        for i in 0..count {
            let around = std::f64::consts::TAU * f64::from(i) / f64::from(count) + angle;
            let direction =
                DVec3::new(angle.sin() * around.cos(), angle.sin() * around.sin(), angle.cos());
            let range_m = 1.0 + f64::from((ring * 7 + i * 5) % 9);
            let size_m = Vec3::splat((1.2 * range_m / px_per_rad) as f32);
            add(&mut splats, direction * range_m, size_m, DQuat::IDENTITY, 0.95);
        }
    }
    splats
}

/// Checks that the centre of every dot of `dots` is where the formula predicts it. Returns the maximum error. [px]
fn check_dots(renderer: &mut dyn Rasterizer, dots: &Splats, camera: &Camera) -> f64 {
    let mut image = [RgbdImage::default()];
    renderer.render(&[], &[*camera], &mut image).expect("a valid camera");
    let image = &image[0];
    let (mut worst_px, mut seen) = (0f64, 0);
    for mean in &dots.means_m {
        // Rounded to f32, as in the scene.
        let Some(expected) = lands(camera, mean.as_dvec3(), 9.0) else { continue };
        let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
        let (left, top) = (expected.x as usize - 8, expected.y as usize - 8);
        for y in top..=top + 16 {
            for x in left..=left + 16 {
                let alpha = f64::from(image.alpha[y * image.width_px as usize + x]);
                sum += (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - expected) * alpha;
                weight += alpha;
            }
        }
        assert!(weight > 1.0, "{}: no dot at {expected}", renderer.name());
        worst_px = worst_px.max((sum / weight).length());
        seen += 1;
    }
    assert!(seen > 40, "{}: only {seen} dots", renderer.name());
    assert!(worst_px <= LIMIT_PX, "{}: {worst_px} px", renderer.name());
    worst_px
}

#[test]
fn checkerboard_corners_match_the_formula() {
    let scene = scene();
    for mut renderer in renderers::every(Scene::from(&scene)) {
        check_corners(renderer.as_mut());
    }
}

#[test]
fn dots_match_the_formula_to_the_rim_of_a_fisheye_3840_px_wide() {
    let f_px = 3840.0 / 170f64.to_radians();
    let k = Intrinsics {
        fx_px: f_px,
        fy_px: f_px,
        distortion: Distortion::KannalaBrandt { k1: 0.01, k2: -0.002, k3: 0.0005, k4: 0.0001 },
        ..Intrinsics::from_horizontal_fov(3840, 2160, 1.0)
    };
    let world_from_cam = Pose::new(DVec3::ZERO, DQuat::from_rotation_z(0.7));
    let camera = Camera::new(k, world_from_cam, 0.05);
    let dots = dots(f_px);
    for mut renderer in renderers::every(Scene::from(&dots)) {
        let worst_px = check_dots(renderer.as_mut(), &dots, &camera);
        println!("{}: worst off by {worst_px:.4} px", renderer.name());
    }
}

/// Returns a wall perpendicular to the z axis at `z_m`, of splats in many colours.
fn wall(z_m: f32) -> Splats {
    let mut splats = Splats::default();
    for y in -30..=30i16 {
        for x in -40..=40i16 {
            let colour = Vec3::new(f32::from(x), f32::from(y), f32::from(x * y)) * 1.7;
            splats.means_m.push(Vec3::new(f32::from(x) * 0.04, f32::from(y) * 0.04, z_m));
            splats.scales_m.push(Vec3::new(0.03, 0.03, 0.001));
            splats.rotations.push(Quat::IDENTITY);
            splats.opacities.push(0.95);
            splats.sh.extend(colour.to_array().map(f32::sin));
        }
    }
    splats
}

/// Checks that two cameras side by side, rendered in one call, see a wall shifted by exactly the disparity, and that
/// each image is bit-identical to that of a separate call.
pub(crate) fn check_stereo(make: renderers::Make<'_>) {
    const BASE_M: f64 = 0.065;
    const Z_M: f32 = 2.6;
    // fx b / z is a whole number: the right image is exactly the shifted left one.
    let k =
        Intrinsics { fx_px: 320.0, fy_px: 320.0, ..Intrinsics::from_horizontal_fov(160, 120, 1.0) };
    let disparity_px = k.fx_px * BASE_M / f64::from(Z_M);
    assert!((disparity_px - 8.0).abs() < 1e-5);
    let eye = |x_m: f64, intrinsics| Camera {
        intrinsics,
        world_from_cam: Pose::<World, Cam>::new(DVec3::new(x_m, 0.0, 0.0), DQuat::IDENTITY),
        near_m: 0.05,
        background: [0.0; 3],
        atmosphere: Atmosphere::CLEAR,
    };
    let fisheye = Intrinsics {
        distortion: Distortion::KannalaBrandt { k1: 0.1, k2: 0.0, k3: 0.0, k4: 0.0 },
        ..k
    };
    let cameras = [eye(0.0, k), eye(BASE_M, k), eye(0.0, fisheye), eye(BASE_M, fisheye)];
    let splats = wall(Z_M);
    for mut renderer in make(Scene::from(&splats)) {
        let name = renderer.name().into_owned();
        let mut together = vec![RgbdImage::default(); cameras.len()];
        renderer.render(&[], &cameras, &mut together).expect("valid cameras");
        for (camera, image) in cameras.iter().zip(&together) {
            let mut alone = [RgbdImage::default()];
            renderer.render(&[], &[*camera], &mut alone).expect("a valid camera");
            assert!(alone[0] == *image, "{name}: image differs between one camera and two");
        }
        let shift = 8;
        for y in 0..120 {
            for x in 0..160 - shift {
                let (left, right) = (y * 160 + x + shift, y * 160 + x);
                for c in 0..3 {
                    let [a, b] = [&together[0], &together[1]].map(|i| &i.rgb);
                    let off = (a[left * 3 + c] - b[right * 3 + c]).abs();
                    assert!(off < 2e-3, "{name}: ({x}, {y}) differs by {off}");
                }
                for eye in &together[..2] {
                    for depth_m in [eye.depth_median_m[right], eye.depth_expected_m[right]] {
                        let from_depth = k.fx_px * BASE_M / f64::from(depth_m);
                        assert!((from_depth - disparity_px).abs() < 1e-3, "{name}: {depth_m} m");
                    }
                }
            }
        }
    }
}

#[test]
fn stereo_disparity_is_exact() {
    check_stereo(&renderers::every);
}
