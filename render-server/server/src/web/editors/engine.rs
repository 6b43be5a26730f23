//! Renders one image: camera pose in, JPEG out.

use anyhow::{Context, Result};
use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_arena::objects::MovingObjects;
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World, body_from_forward_cam};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_splat::{Atmosphere, Camera, DepthKind, Rasterizer, RgbdImage};

use super::pick::{self, PickError, Picked};
use super::place::{self, Place};
use crate::scene::WorldFromScene;
use crate::web::previews::depth_colour;

/// Request of an image.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Request {
    /// Position of the camera. [m, world]
    p_m: [f64; 3],
    /// Heading: from x, counter-clockwise. [rad, world]
    yaw_rad: f64,
    /// Upward tilt. [rad]
    pitch_rad: f64,
    /// Horizontal field of view. [deg]
    fov_deg: f64,
    /// [px]
    width_px: u32,
    /// [px]
    height_px: u32,
    /// Whether to render depth instead of colour.
    depth: bool,
    /// Time on the clock of moving objects. [s]
    #[serde(default)]
    at_s: f64,
    /// Placement of the scene's file in the world of `p_m`; default: the placement at loading.
    #[serde(default)]
    place: Option<Place>,
    /// Whether to send depths, for the page's overlay.
    #[serde(default)]
    grid: bool,
}

/// Description of an image, sent before it.
#[derive(Debug, Serialize)]
pub(super) struct PictureInfo {
    ms: f32,
    visible: usize,
    /// Median depth at the centre of the image; `None` without a surface. [m]
    middle_m: Option<f32>,
    camera: OracleCamera,
    grid: Option<DepthGrid>,
}

/// Median depths at the centres of square cells, row by row.
#[derive(Debug, Serialize)]
struct DepthGrid {
    columns: u32,
    /// Side of a cell. [px]
    cell_px: u32,
    /// 0 without a surface. [mm, cam]
    depth_mm: Vec<u16>,
}

/// The camera in the frame of the scene's file, in the format of `vizflyt scene render`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct OracleCamera {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    w: u32,
    h: u32,
    bg: [f32; 3],
    w2c: [[f64; 4]; 4],
    near_m: f64,
}

pub(super) struct Picture {
    pub(super) info: PictureInfo,
    pub(super) jpeg: Vec<u8>,
}

/// Renderer and reused buffers.
pub(super) struct Engine {
    rasterizer: Box<dyn Rasterizer>,
    moving: MovingObjects,
    /// From the frame of `CAM.json` files.
    world_from_scene: WorldFromScene,
    /// From the frame of the scene's file.
    world_from_file: WorldFromScene,
    image: [RgbdImage; 1],
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
}

impl Engine {
    pub(super) fn new(
        rasterizer: Box<dyn Rasterizer>,
        moving: MovingObjects,
        world_from_scene: WorldFromScene,
        world_from_file: WorldFromScene,
    ) -> Self {
        let (image, rgb, depth_mm) = ([RgbdImage::default()], Vec::new(), Vec::new());
        Self { rasterizer, moving, world_from_scene, world_from_file, image, rgb, depth_mm }
    }

    /// Returns the camera in the world at loading, and the scale from the request's world to it.
    fn loaded_camera(&self, request: &Request) -> Result<(Camera, f64)> {
        let camera = request.camera();
        let Some(place) = &request.place else { return Ok((camera, 1.0)) };
        let shown = place.world_from_scene();
        let shown =
            shown.context("the place is invalid: give a unit quaternion and finite numbers")?;
        let by = place::between(&self.world_from_file, &shown);
        Ok((place::moved(&camera, &by), by.scale))
    }

    /// Returns the point of the scene at a pixel of the image of `request`.
    pub(super) fn pick(
        &mut self,
        request: &Request,
        px: DVec2,
    ) -> Result<Result<Picked, PickError>> {
        let camera = request.camera();
        let Some((window, px_of_window)) = pick::window(&camera.intrinsics, px) else {
            return Ok(Err(PickError::Outside));
        };
        let (loaded, unit) = self.loaded_camera(request)?;
        let looking = Camera { intrinsics: window, ..loaded };
        let placements = self.moving.placements((request.at_s * 1e9) as i64);
        self.rasterizer.render(&placements, &[looking], &mut self.image)?;
        let (depth_m, rough_m) = match pick::surface(&self.image[0].depth_median_m, px_of_window) {
            Ok(found) => found,
            Err(PickError::Edge { near_m, far_m }) => {
                return Ok(Err(PickError::Edge { near_m: near_m / unit, far_m: far_m / unit }));
            }
            Err(error) => return Ok(Err(error)),
        };
        let p_cam = window.unproject(px_of_window, depth_m).context("the lens shows nothing")?;
        let p_loaded = loaded.world_from_cam.transform_point(p_cam);
        let file = &self.world_from_file;
        let p_scene = file.rotation.conjugate() * (p_loaded - file.translation_m) / file.scale;
        let p_world = camera.world_from_cam.transform_point(p_cam / unit);
        let (depth_m, rough_m) = (depth_m / unit, rough_m / unit);
        Ok(Ok(Picked { p_scene, p_world, depth_m, rough_m }))
    }

    /// Replaces the scene at the same placement.
    pub(super) fn replace(&mut self, rasterizer: Box<dyn Rasterizer>) {
        self.rasterizer = rasterizer;
    }

    /// Replaces the objects, and the renderer if one is given.
    pub(super) fn set_objects(
        &mut self,
        rasterizer: Option<Box<dyn Rasterizer>>,
        moving: MovingObjects,
    ) {
        self.moving = moving;
        if let Some(rasterizer) = rasterizer {
            self.rasterizer = rasterizer;
        }
    }

    pub(super) fn render(&mut self, request: &Request) -> Result<Picture> {
        let (camera, unit) = self.loaded_camera(request)?;
        // A time outside the clock's range shows the start.
        let placements = self.moving.placements((request.at_s * 1e9) as i64);
        let times = self.rasterizer.render(&placements, &[camera], &mut self.image)?;
        let [image] = &self.image;
        if request.depth {
            image.write_depth_mm(DepthKind::Median, &mut self.depth_mm);
            self.rgb.clear();
            self.rgb.extend(self.depth_mm.iter().flat_map(|&mm| depth_colour(mm)));
        } else {
            image.write_rgb8(&mut self.rgb);
        }
        let (width, height) = (image.width_px, image.height_px);
        let mut jpeg = Vec::new();
        encode_jpeg(&self.rgb, width, height, QUALITY, &mut jpeg).context("no picture")?;
        let middle = (height / 2) as usize * width as usize + (width / 2) as usize;
        let middle_m = image.depth_median_m[middle];
        let info = PictureInfo {
            ms: times.total_ms,
            visible: self.rasterizer.workload().visible,
            middle_m: (middle_m > 0.0).then_some(middle_m / unit as f32),
            camera: in_scene(&camera, &self.world_from_scene),
            grid: request.grid.then(|| DepthGrid::of(image, unit)),
        };
        Ok(Picture { info, jpeg })
    }
}

impl DepthGrid {
    fn of(image: &RgbdImage, unit: f64) -> Self {
        let cell_px = (image.width_px.max(image.height_px) / GRID).max(1);
        let [columns, rows] = [image.width_px, image.height_px].map(|side| side.div_ceil(cell_px));
        let middle = |cell: u32, side: u32| (cell * cell_px + cell_px / 2).min(side - 1) as usize;
        let at = |column, row| {
            let k = middle(row, image.height_px) * image.width_px as usize
                + middle(column, image.width_px);
            // Saturates at 65 m: more distant surfaces hide nothing that is nearer.
            (f64::from(image.depth_median_m[k]) / unit * 1e3) as u16
        };
        let depth_mm = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
        let depth_mm = depth_mm.map(|(column, row)| at(column, row)).collect();
        Self { columns, cell_px, depth_mm }
    }
}

impl Request {
    /// Returns the camera, with its size limited to that of a page.
    pub(super) fn camera(&self) -> Camera {
        let [width, height] =
            [self.width_px, self.height_px].map(|side| side.clamp(16, MAX_SIDE_PX));
        let fov_rad = self.fov_deg.clamp(5.0, 150.0).to_radians();
        let world_from_body: Pose<World, Body> =
            Pose::new(self.p_m.into(), DQuat::from_rotation_z(self.yaw_rad));
        Camera {
            intrinsics: Intrinsics::from_horizontal_fov(width, height, fov_rad),
            world_from_cam: world_from_body * body_from_forward_cam(DVec3::ZERO, self.pitch_rad),
            near_m: NEAR_M,
            background: [0.0; 3],
            atmosphere: Atmosphere::CLEAR,
        }
    }
}

/// Returns the camera that renders the unscaled, unrotated scene file as `camera` renders the twin: `p_cam = R_cw (s
/// R_ws p + t_ws) + t_cw`, divided by s.
fn in_scene(camera: &Camera, world_from_scene: &WorldFromScene) -> OracleCamera {
    let cam_from_world = camera.world_from_cam.inverse();
    let rotation = DMat3::from_quat(cam_from_world.rotation * world_from_scene.rotation);
    let t = cam_from_world.transform_point(world_from_scene.translation_m) / world_from_scene.scale;
    let rows = rotation.transpose();
    let row = |axes: DVec3, t: f64| [axes.x, axes.y, axes.z, t];
    let k = &camera.intrinsics;
    OracleCamera {
        fx: k.fx_px,
        fy: k.fy_px,
        cx: k.cx_px,
        cy: k.cy_px,
        w: k.width_px,
        h: k.height_px,
        bg: camera.background,
        w2c: [
            row(rows.x_axis, t.x),
            row(rows.y_axis, t.y),
            row(rows.z_axis, t.z),
            [0.0, 0.0, 0.0, 1.0],
        ],
        near_m: f64::from(camera.near_m) / world_from_scene.scale,
    }
}

/// Small, because the camera can fly through objects. [m]
const NEAR_M: f32 = 0.05;
/// Full HD in landscape format.
const MAX_SIDE_PX: u32 = 1920;
const QUALITY: u8 = 85;
/// Cells along the longer side: at most 100 kB of text.
const GRID: u32 = 180;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use vizflyt_arena::config::{MotionConfig, ObjectConfig};
    use vizflyt_splat::{CpuRenderer, RigidObject, Scene, Splats};

    fn ball() -> Splats {
        Splats {
            means_m: vec![Vec3::new(3.0, 0.5, 1.0)],
            scales_m: vec![Vec3::splat(0.2)],
            rotations: vec![Quat::IDENTITY],
            opacities: vec![1.0],
            sh_degree: 0,
            sh: vec![1.0; 3],
            antialiased: false,
        }
    }

    fn request() -> Request {
        Request {
            p_m: [0.0, 0.5, 1.0],
            yaw_rad: 0.0,
            pitch_rad: 0.0,
            fov_deg: 60.0,
            width_px: 64,
            height_px: 48,
            depth: false,
            at_s: 0.0,
            place: None,
            grid: false,
        }
    }

    fn still(splats: &Splats) -> Engine {
        let renderer = Box::new(CpuRenderer::new(splats));
        Engine::new(
            renderer,
            MovingObjects::default(),
            WorldFromScene::IDENTITY,
            WorldFromScene::IDENTITY,
        )
    }

    #[test]
    fn moving_objects_follow_the_clock() {
        let authorizer = ObjectConfig {
            name: "door".into(),
            scene: "door.ply".into(),
            position_m: DVec3::new(0.0, 0.5, 0.0),
            yaw_deg: 0.0,
            phase_s: Some(0.0),
            motion: Some(MotionConfig::Path {
                points_m: vec![DVec3::ZERO, DVec3::Y * 5.0],
                speed_mps: 1.0,
                closed: false,
            }),
        };
        // The ball is the object; the room is empty.
        let objects = [RigidObject { id: 1, splats: ball() }];
        let empty = Splats::default();
        let scene = Scene { splats: &empty, objects: &objects };
        let renderer = Box::new(CpuRenderer::new(scene));
        let moving = MovingObjects::of(&[authorizer], 0);
        let mut engine =
            Engine::new(renderer, moving, WorldFromScene::IDENTITY, WorldFromScene::IDENTITY);
        let mut middle_m = |p_y_m: f64, at_s: f64| {
            let looking = Request { p_m: [0.0, p_y_m, 1.0], at_s, ..request() };
            engine.render(&looking).unwrap().info.middle_m
        };
        assert_eq!((middle_m(1.0, 0.0), middle_m(1.0, 4.0)), (Some(3.0), None));
        assert_eq!((middle_m(5.0, 0.0), middle_m(5.0, 4.0)), (None, Some(3.0)));
    }

    #[test]
    fn renders_the_scene_ahead_with_its_depth() {
        let splats = ball();
        let mut engine = still(&splats);
        let picture = engine.render(&request()).unwrap();
        assert_eq!((picture.info.visible, picture.info.middle_m), (1, Some(3.0)));
        assert_eq!(picture.jpeg[..2], [0xff, 0xd8]);
        let behind = Request { yaw_rad: std::f64::consts::PI, depth: true, ..request() };
        let picture = engine.render(&behind).unwrap();
        assert_eq!((picture.info.visible, picture.info.middle_m), (0, None));
        let lost = Request { p_m: [1e30, 0.0, 0.0], ..request() };
        assert!(engine.render(&lost).is_err());
        let huge = Request { width_px: u32::MAX, height_px: 0, ..request() };
        assert_eq!(huge.camera().intrinsics.pixels(), 1920 * 16);
    }

    /// Rotation, translation and scale of the scene: same image, distances in the new unit, and clicks return the
    /// file's point.
    #[test]
    fn moving_scene_and_camera_together_keeps_the_image() {
        let splats = ball();
        let mut engine = still(&splats);
        let here = engine.render(&request()).unwrap();
        // Rotated by a right angle about z, twice as large, 1 m up: the camera looks along y.
        let half = std::f64::consts::FRAC_PI_2;
        let turned = WorldFromScene {
            scale: 2.0,
            rotation: DQuat::from_rotation_z(half),
            translation_m: DVec3::Z,
        };
        let elsewhere = Request {
            p_m: [-1.0, 0.0, 3.0],
            yaw_rad: half,
            place: Some(Place::new(&turned)),
            grid: true,
            ..request()
        };
        let there = engine.render(&elsewhere).unwrap();
        assert_eq!(there.info.middle_m, Some(6.0));
        let grid = there.info.grid.unwrap();
        assert_eq!((grid.columns, grid.cell_px, grid.depth_mm.len()), (64, 1, 64 * 48));
        assert_eq!(grid.depth_mm[24 * 64 + 32], 6000);
        assert!(there.jpeg == here.jpeg && here.info.grid.is_none());
        // The ball is 4 px wide, smaller than the window; a narrow view fills the window with it.
        let middle = DVec2::new(32.0, 24.0);
        assert_eq!(engine.pick(&elsewhere, middle).unwrap(), Err(PickError::Nothing));
        let close = Request { fov_deg: 5.0, ..elsewhere };
        let picked = engine.pick(&close, middle).unwrap().unwrap();
        assert!(picked.p_scene.distance(DVec3::new(3.0, 0.5, 1.0)) < 1e-3, "{picked:?}");
        assert!(picked.p_world.distance(DVec3::new(-1.0, 6.0, 3.0)) < 1e-3, "{picked:?}");
        let no_place = serde_json::from_str::<Place>(
            r#"{"rotation": [0, 0, 0, 0], "metres_per_unit": 1, "origin": [0, 0, 0]}"#,
        );
        let lost = Request { place: Some(no_place.unwrap()), ..request() };
        assert!(engine.render(&lost).is_err());
    }

    /// A point of the file maps to the same pixel with both cameras.
    #[test]
    fn the_copied_camera_is_in_the_files_own_frame() {
        let world_from_scene = WorldFromScene {
            scale: 0.25,
            rotation: DQuat::from_rotation_x(1.1) * DQuat::from_rotation_z(0.4),
            translation_m: DVec3::new(1.0, -2.0, 3.0),
        };
        let looking = Request { yaw_rad: 0.7, pitch_rad: -0.2, ..request() };
        let camera = looking.camera();
        let copied = in_scene(&camera, &world_from_scene);
        let p_cam = DVec3::new(0.3, -0.2, 4.0);
        let p_world = camera.world_from_cam.transform_point(p_cam);
        let p_scene = world_from_scene.rotation.inverse()
            * (p_world - world_from_scene.translation_m)
            / world_from_scene.scale;
        let row = |k: usize| {
            let [x, y, z, t] = copied.w2c[k];
            DVec3::new(x, y, z).dot(p_scene) + t
        };
        let found = DVec3::new(row(0), row(1), row(2));
        // The same ray, in units of the file.
        assert!((found * 0.25 - p_cam).length() < 1e-9, "{found}");
        assert!((copied.near_m - 0.2).abs() < 1e-6);
    }
}
