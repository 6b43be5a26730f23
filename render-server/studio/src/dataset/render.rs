//! Renders an image with all layers: a function of the scene and the shot, on one thread.

use anyhow::Result;
use glam::DVec3;
use vizflyt_protocol::geometry::{Cam, Pose};
use vizflyt_server::render::environment::{atmosphere, weather};
use vizflyt_splat::weather::{Moment, WeatherPass};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Scene};

use super::classes::Classes;
use super::record::{
    CameraRecord, CornerRecord, GateRecord, ImageRecord, NextRecord, PoseRecord, ThingRecord,
};
use super::shot::{Shot, motion};
use super::world::{Gate, Slot, World};
use crate::labels::flow::Flow;
use crate::labels::normals::Normals;
use crate::labels::{layers, rle};

/// Renderer of a scene; each thread has one.
pub(super) struct LabelRenderer<'a> {
    world: &'a World,
    renderer: CpuRenderer,
    images: [RgbdImage; 1],
    weather: WeatherPass,
    normals: Normals,
    flow: Flow,
    class_of_id: Vec<u8>,
    /// Whether an id belongs to a thing.
    is_thing: Vec<bool>,
}

/// All layers, row-major. Layers that are not requested are empty.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Layers {
    /// H x W x 3, sRGB.
    pub(super) rgb: Vec<u8>,
    /// Colours at the second time and pose of the optical flow.
    pub(super) next: Vec<u8>,
    /// Depth of surfaces; 0: none. [m, cam]
    pub(super) depth_m: Vec<f32>,
    /// H x W x 3; see [`Normals::write`].
    pub(super) normals: Vec<u8>,
    /// Ids of things; 0 for surroundings.
    pub(super) instances: Vec<u16>,
    pub(super) classes: Vec<u8>,
    /// H x W x 3; see [`Flow::write`].
    pub(super) flow: Vec<u16>,
}

/// Requested layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Wanted {
    pub(super) next: bool,
    pub(super) normals: bool,
    pub(super) classes: bool,
    pub(super) flow: bool,
}

impl<'a> LabelRenderer<'a> {
    /// Prepares the renderer of a scene.
    pub(super) fn new(world: &'a World, classes: &Classes) -> Self {
        let scene = Scene { splats: &world.rest, objects: &world.objects };
        let class_of_id = world.class_of_id();
        let is_thing = class_of_id.iter().map(|&class| classes.is_thing(class)).collect();
        let renderer = CpuRenderer::new(scene);
        Self {
            world,
            renderer,
            images: [RgbdImage::default()],
            weather: WeatherPass::default(),
            normals: Normals::default(),
            flow: Flow::default(),
            class_of_id,
            is_thing,
        }
    }

    /// Renders a shot.
    ///
    /// # Errors
    /// The renderer rejects the pose or the intrinsics.
    pub(super) fn render(&mut self, shot: &Shot, wanted: Wanted, out: &mut Layers) -> Result<()> {
        let world = self.world;
        let k = &shot.intrinsics;
        out.next.clear();
        if let (true, Some((at_ns, world_from_cam))) = (wanted.next, shot.next) {
            self.picture(shot, at_ns, world_from_cam)?;
            self.images[0].write_rgb8(&mut out.next);
        }
        self.picture(shot, shot.at_ns, shot.world_from_cam)?;
        let [image] = &self.images;
        image.write_rgb8(&mut out.rgb);
        layers::surface_depth(image, &mut out.depth_m);
        if wanted.normals {
            self.normals.write(k, &out.depth_m, &mut out.normals);
        }
        if wanted.classes {
            layers::classes(&out.depth_m, &image.ids, &self.class_of_id, &mut out.classes);
        }
        if wanted.flow {
            if let Some((next_ns, next)) = shot.next {
                let next_from_world = next.inverse();
                let next_from_cam: Pose<Cam, Cam> = next_from_world * shot.world_from_cam;
                let moved = world.objects.iter().zip(&world.slots).filter_map(|(object, slot)| {
                    let Slot::Mover(index) = *slot else { return None };
                    let at = |ns| world.movers.placement(index, ns);
                    let moved = motion(&at(shot.at_ns), &at(next_ns));
                    Some((object.id, next_from_world * moved * shot.world_from_cam))
                });
                let moved: Vec<(u16, Pose<Cam, Cam>)> = moved.collect();
                let (depth_m, ids) = (&out.depth_m, &image.ids);
                self.flow.write(k, depth_m, ids, &next_from_cam, &moved, &mut out.flow);
            } else {
                out.flow.clear();
                out.flow.resize(3 * k.pixels(), 0);
            }
        }
        layers::instances(&out.depth_m, &image.ids, &self.is_thing, &mut out.instances);
        Ok(())
    }

    fn picture(
        &mut self,
        shot: &Shot,
        at_ns: i64,
        world_from_cam: Pose<vizflyt_protocol::geometry::World, Cam>,
    ) -> Result<()> {
        let atmosphere = atmosphere(&shot.environment);
        let camera = Camera { atmosphere, ..Camera::new(shot.intrinsics, world_from_cam, NEAR_M) };
        let placements = shot.placements(self.world, at_ns);
        self.renderer.render(&placements, &[camera], &mut self.images)?;
        let moment = Moment { at_ns, v_world_mps: DVec3::ZERO, seed: shot.seed };
        self.weather.apply(&weather(&shot.environment), &camera, &moment, &mut self.images[0]);
        Ok(())
    }

    /// Returns the record of the image that was just rendered.
    pub(super) fn record(
        &self,
        shot: &Shot,
        index: u64,
        split: &str,
        scene: &str,
        classes: &Classes,
        layers: &Layers,
    ) -> ImageRecord {
        let world = self.world;
        let size = [shot.intrinsics.width_px as usize, shot.intrinsics.height_px as usize];
        let thing = |(id, mask): (u16, rle::Mask)| {
            let thing = &world.things[usize::from(id) - 1];
            ThingRecord {
                id,
                name: thing.name.clone(),
                class: classes.name(thing.class).to_owned(),
                area_px: mask.area_px,
                box_px: mask.box_px,
                rle: rle::to_text(&mask.counts),
            }
        };
        let things: Vec<ThingRecord> =
            rle::masks(&layers.instances, size).into_iter().map(thing).collect();
        let is_seen = |gate: &Gate| gate.id != 0 && things.iter().any(|thing| thing.id == gate.id);
        let gates = world.gates.iter().filter_map(|gate| {
            let record = gate_record(gate, shot, &layers.depth_m);
            let has_corner = record.corners.iter().any(|corner| corner.visibility > 0);
            (has_corner || is_seen(gate)).then_some(record)
        });
        let gates = gates.collect();
        let next = shot
            .next
            .map(|(at_ns, pose)| NextRecord { at_ns, world_from_cam: PoseRecord::of(&pose) });
        ImageRecord {
            index,
            split: split.to_owned(),
            scene: scene.to_owned(),
            seed: world.seed,
            at_ns: shot.at_ns,
            camera: CameraRecord::of(&shot.intrinsics),
            world_from_cam: PoseRecord::of(&shot.world_from_cam),
            next,
            environment: shot.environment,
            things,
            gates,
        }
    }
}

/// Returns the record of a gate: pose and corners.
fn gate_record(gate: &Gate, shot: &Shot, depth_m: &[f32]) -> GateRecord {
    let cam_from_world = shot.world_from_cam.inverse();
    let corners = gate.corners_m().map(|corner_m| {
        let p_cam = cam_from_world.transform_point(corner_m);
        corner(&shot.intrinsics, p_cam, depth_m)
    });
    let cam_from_gate = cam_from_world * gate.world_from_gate;
    GateRecord {
        name: gate.name.clone(),
        id: gate.id,
        cam_from_gate: PoseRecord::of(&cam_from_gate),
        size_m: gate.size_m,
        corners,
    }
}

/// Returns the record of a corner. It is hidden if the surface in its pixel is well in front of it.
fn corner(
    k: &vizflyt_protocol::geometry::Intrinsics,
    p_cam: glam::DVec3,
    depth_m: &[f32],
) -> CornerRecord {
    let Some(pixel) = k.project(p_cam).filter(|_| p_cam.z > f64::from(NEAR_M)) else {
        return CornerRecord { at_px: [0.0; 2], depth_m: p_cam.z, visibility: 0 };
    };
    let (width, height) = (f64::from(k.width_px), f64::from(k.height_px));
    let is_inside = (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y);
    let visibility = if is_inside {
        let seen_m = depth_m[pixel.y as usize * k.width_px as usize + pixel.x as usize];
        // A pixel without a surface hides nothing.
        let is_hidden = seen_m > 0.0 && f64::from(seen_m) < p_cam.z - HIDDEN_M;
        if is_hidden { 1 } else { 2 }
    } else {
        0
    };
    CornerRecord { at_px: pixel.to_array(), depth_m: p_cam.z, visibility }
}

/// Near limit, as for cameras of arenas. [m]
const NEAR_M: f32 = 0.05;
/// Minimum distance of a hiding surface in front of a corner. A corner is in the middle of its bars, and half of their
/// thickness, seen at an angle, must not hide it. [m]
const HIDDEN_M: f64 = 0.12;
