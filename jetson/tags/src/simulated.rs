//! Simulated webcams: true poses of the vehicle in, images with the time of exposure out. Sans-IO.
//!
//! [`Truth`] keeps the true poses of the last second. [`SimulatedCamera`] renders an image when the truth covers its
//! whole exposure. Cameras run unsynchronized, each with its own phase, as webcams do. This module contains the lab's
//! two setups: webcams in the room with a [`cube`] on the vehicle, and in [`over_mat`] a webcam under the vehicle.

pub mod over_mat;

use std::collections::VecDeque;

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Distortion, Intrinsics, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::camera::{Mounting, TagCamera};
use crate::family::TagFamily;
use crate::image::Gray;
use crate::layout::{LayoutFrame, Tag, TagLayout};
use crate::synth::{Light, Placed, Renderer, SyntheticExposure};

/// True poses of the vehicle in the last second.
#[derive(Clone, Debug, Default)]
pub struct Truth {
    past: VecDeque<(HostTime, Pose<World, Body>)>,
}

impl Truth {
    /// Adds a pose. A pose that is not newer than the last is dropped. If it is older by more than the kept span, the
    /// clock was set back, and all earlier poses are removed.
    pub fn push(&mut self, stamp: HostTime, world_from_body: Pose<World, Body>) {
        if let Some(&(newest, _)) = self.past.back()
            && stamp <= newest
        {
            if newest.seconds_since(stamp) < TRUTH_SPAN_S {
                return;
            }
            self.past.clear();
        }
        self.past.push_back((stamp, world_from_body));
        while self.past.front().is_some_and(|(old, _)| stamp.seconds_since(*old) > TRUTH_SPAN_S) {
            self.past.pop_front();
        }
    }

    /// Returns the stamp of the newest pose.
    pub fn newest(&self) -> Option<HostTime> {
        self.past.back().map(|(stamp, _)| *stamp)
    }

    /// Returns the interpolated pose at an instant; `None` outside the known span.
    pub fn at(&self, stamp: HostTime) -> Option<Pose<World, Body>> {
        let after = self.past.partition_point(|(at, _)| *at < stamp);
        let (end, last) = self.past.get(after)?;
        if *end == stamp {
            return Some(*last);
        }
        let (begin, first) = self.past.get(after.checked_sub(1)?)?;
        let t = stamp.seconds_since(*begin) / end.seconds_since(*begin);
        Some(first.interpolate(last, t))
    }
}

/// Imaging parameters of a simulated camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Frame rate. [Hz]
    pub rate_hz: f64,
    /// Offset of the first exposure after a whole second, as a share of the interval between images.
    pub phase: f64,
    /// Exposure time. [s]
    pub exposure_s: f64,
    /// Standard deviation of the optical blur. [px]
    pub blur_px: f64,
    /// Focus distance of the lens. [m]
    pub focus_m: f64,
    /// Aperture of the lens, which blurs objects outside the focus distance; 0 is a pinhole. [m]
    pub aperture_m: f64,
    /// Standard deviation of the sensor noise. [grey levels of 255]
    pub noise: f64,
    /// Lighting of the scene.
    pub light: Light,
}

impl Default for Sensor {
    fn default() -> Self {
        Self {
            rate_hz: 30.0,
            phase: 0.0,
            exposure_s: 0.004,
            blur_px: 0.6,
            focus_m: 1.0,
            aperture_m: 0.0,
            noise: 4.0,
            light: Light { gradient: DVec2::new(0.4, -0.3), vignette: 0.3, ..Light::default() },
        }
    }
}

/// A camera that renders tags at their true poses.
#[derive(Debug)]
pub struct SimulatedCamera {
    camera: TagCamera,
    renderer: Renderer,
    sensor: Sensor,
    /// Index of the next image since the clock's zero.
    next: Option<u64>,
    behind: Option<Background>,
}

/// Renders the background behind the tags for a camera pose, in the size of the camera's image.
pub struct Background(Box<RenderBackground>);

type RenderBackground = dyn FnMut(&Pose<World, Cam>) -> Gray + Send;

impl Background {
    /// Makes a background from a render function.
    pub fn new(render: impl FnMut(&Pose<World, Cam>) -> Gray + Send + 'static) -> Self {
        Self(Box::new(render))
    }
}

impl std::fmt::Debug for Background {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Behind")
    }
}

impl SimulatedCamera {
    pub fn new(camera: TagCamera, sensor: Sensor) -> Self {
        let renderer = Renderer::new(camera.intrinsics);
        Self { camera, renderer, sensor, next: None, behind: None }
    }

    /// Makes a camera with a rendered background instead of a cluttered wall.
    #[must_use]
    pub fn before(camera: TagCamera, sensor: Sensor, behind: Background) -> Self {
        Self { behind: Some(behind), ..Self::new(camera, sensor) }
    }

    pub fn camera(&self) -> &TagCamera {
        &self.camera
    }

    /// Returns the middle of the next exposure that the truth covers, if there is one.
    pub fn due(&mut self, truth: &Truth) -> Option<HostTime> {
        let newest = truth.newest()?;
        let interval_s = 1.0 / self.sensor.rate_hz;
        let middle = |n: u64| {
            HostTime::from_ns(((n as f64 + self.sensor.phase) * interval_s * 1e9).round() as u64)
        };
        let first = truth.past.front().map(|(stamp, _)| *stamp)?;
        let half_s = 0.5 * self.sensor.exposure_s;
        // Missed images are not rendered later.
        let earliest = (first.plus_seconds(half_s).as_ns() as f64 * 1e-9 / interval_s
            - self.sensor.phase)
            .ceil()
            .max(0.0) as u64;
        let next = self.next.map_or(earliest, |next| {
            // If the clock was set back, restart from the earliest exposure.
            let latest = (newest.as_ns() as f64 * 1e-9 / interval_s).ceil() as u64 + 1;
            if next > latest { earliest } else { next.max(earliest) }
        });
        self.next = Some(next);
        let stamp = middle(next);
        (stamp.plus_seconds(half_s) <= newest).then_some(stamp)
    }

    /// Renders the image that is [due](Self::due); `None` if none is. With `latest`, only the newest of several due
    /// images is rendered.
    pub fn expose(
        &mut self,
        truth: &Truth,
        layouts: &[TagLayout],
        latest: bool,
    ) -> Option<(HostTime, Gray)> {
        let mut stamp = self.due(truth)?;
        self.next = self.next.map(|next| next + 1);
        if latest {
            while let Some(newer) = self.due(truth) {
                stamp = newer;
                self.next = self.next.map(|next| next + 1);
            }
        }
        let half_s = 0.5 * self.sensor.exposure_s;
        let ends = [truth.at(stamp.plus_seconds(-half_s))?, truth.at(stamp.plus_seconds(half_s))?];
        let placed: Vec<Placed> = layouts
            .iter()
            .map(|layout| match layout.frame {
                LayoutFrame::World => Placed::fixed(layout),
                LayoutFrame::Body => Placed::on_vehicle(layout, ends),
            })
            .collect();
        let world_from_cam = match self.camera.mounting {
            Mounting::World(pose) => [pose; 2],
            Mounting::Body(body_from_cam) => ends.map(|pose| pose * body_from_cam),
            Mounting::Unknown => return None,
        };
        let middle = world_from_cam[0].interpolate(&world_from_cam[1], 0.5);
        let background = self.behind.as_mut().map(|behind| (behind.0)(&middle));
        let image = self.renderer.render(&SyntheticExposure {
            background: background.as_ref(),
            light: self.sensor.light,
            blur_px: self.sensor.blur_px.hypot(self.defocus_px(&placed, &middle)),
            noise: self.sensor.noise,
            seed: stamp.as_ns(),
            ..SyntheticExposure {
                world_from_cam,
                ..SyntheticExposure::still(&placed, world_from_cam[0])
            }
        });
        Some((stamp, image))
    }

    /// Returns the standard deviation of the defocus blur at the nearest visible tag. [px]
    fn defocus_px(&self, placed: &[Placed], world_from_cam: &Pose<World, Cam>) -> f64 {
        let Sensor { focus_m, aperture_m, .. } = self.sensor;
        let k = &self.camera.intrinsics;
        let (cam_from_world, size) =
            (world_from_cam.inverse(), DVec2::new(k.width_px.into(), k.height_px.into()));
        let p_cam = placed.iter().flat_map(Placed::middles_m);
        let p_cam = p_cam.map(|p_m| cam_from_world.transform_point(p_m));
        let is_seen = |p_m: &DVec3| {
            k.project(*p_m).is_some_and(|px| px.cmpge(DVec2::ZERO).all() && px.cmple(size).all())
        };
        let nearest_m = p_cam.filter(is_seen).map(|p_m| p_m.z).fold(f64::INFINITY, f64::min);
        if !nearest_m.is_finite() {
            return 0.0;
        }
        // The standard deviation of a disc along an axis is a quarter of its diameter.
        let disc = aperture_m * (nearest_m.recip() - focus_m.recip()).abs();
        0.25 * k.fx_px * disc
    }
}

/// Returns the cube of the simulated lab: 0.25 m, a tag of 0.2 m on each side and on top, as printed by `vizflyt tags
/// print cube --paper a3 --face-mm 250 --tag-mm 200`. It is mounted on the vehicle's back. Smaller tags have too few
/// pixels at the far end of a hall of 11 m.
///
/// Ids 0 to 4: nose, left, tail, right, top.
pub fn cube() -> TagLayout {
    let faces = [
        (DVec3::X, DVec3::Z),
        (DVec3::Y, DVec3::Z),
        (DVec3::NEG_X, DVec3::Z),
        (DVec3::NEG_Y, DVec3::Z),
        (DVec3::Z, DVec3::X),
    ];
    let tags = (0..).zip(faces).map(|(id, (normal, up))| {
        let axes = DMat3::from_cols(up.cross(normal), up, normal);
        let position_m = DVec3::new(0.0, 0.0, CUBE_HEIGHT_M) + normal * (CUBE_M / 2.0);
        let rotation_xyzw = DQuat::from_mat3(&axes);
        Tag { family: TagFamily::Tag36h11, id, size_m: CUBE_TAG_M, position_m, rotation_xyzw }
    });
    TagLayout { frame: LayoutFrame::Body, tags: tags.collect() }
}

/// Returns one to four webcams of the simulated lab, the netted hall of 11 x 4.5 x 3.65 m (x from 0 to 11, y from -2.25
/// to 2.25). They have 1280 x 720 pixels, a horizontal field of view of 62 degrees, and the distortion of a webcam. The
/// first two are at the hall's ends in opposite corners, behind the net and under its ceiling.
pub fn webcams(count: usize) -> Vec<TagCamera> {
    let places = [
        ("west", DVec3::new(-0.4, 2.0, 3.3), DVec3::new(5.5, -0.3, 1.0)),
        ("east", DVec3::new(11.4, -2.0, 3.3), DVec3::new(5.5, 0.3, 1.0)),
        ("southwest", DVec3::new(-0.4, -2.0, 3.3), DVec3::new(5.5, 0.3, 1.0)),
        ("northeast", DVec3::new(11.4, 2.0, 3.3), DVec3::new(5.5, -0.3, 1.0)),
    ];
    let made = places.into_iter().take(count).enumerate().map(|(i, (name, from, at))| {
        // Each lens differs slightly.
        let off = i as f64;
        let k = Intrinsics::from_horizontal_fov(1280, 720, 62f64.to_radians());
        let distortion = Distortion::BrownConrady {
            k1: -0.12 + 0.01 * off,
            k2: 0.03,
            p1: 0.0008,
            p2: -0.0005,
            k3: 0.0,
        };
        TagCamera {
            name: name.into(),
            source: None,
            intrinsics: Intrinsics {
                cx_px: k.cx_px + 4.0 - off,
                cy_px: k.cy_px - 3.0,
                distortion,
                ..k
            },
            mounting: Mounting::World(looking(from, at)),
            calibration: None,
            survey: None,
            latency_ms: 0.0,
        }
    });
    made.collect()
}

/// Returns a camera at `from_m` that looks at `at_m`, with its x axis level.
fn looking(from_m: DVec3, at_m: DVec3) -> Pose<World, Cam> {
    let z = (at_m - from_m).normalize();
    let x = z.cross(DVec3::Z).normalize();
    Pose::new(from_m, DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)))
}

/// Time span of kept true poses. [s]
const TRUTH_SPAN_S: f64 = 1.0;
/// Edge of the cube. [m]
const CUBE_M: f64 = 0.25;
/// Edge of the black squares: a face has ten cells of 25 mm, the square eight. [m]
const CUBE_TAG_M: f64 = 0.2;
/// Height of the cube's middle above the vehicle's origin. [m]
const CUBE_HEIGHT_M: f64 = 0.165;

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: f64) -> Pose<World, Body> {
        Pose::new(DVec3::X * x, DQuat::IDENTITY)
    }

    #[test]
    fn interpolates_true_poses_and_drops_old_ones() {
        let mut truth = Truth::default();
        let at = |ms: u64| HostTime::from_ns(ms * 1_000_000);
        assert!(truth.at(at(5)).is_none());
        for ms in [10_000, 10_010, 10_005, 10_020] {
            truth.push(at(ms), pose(ms as f64));
        }
        assert_eq!(truth.at(at(10_015)).unwrap().translation_m.x, 10_015.0);
        assert_eq!(truth.at(at(10_000)).unwrap().translation_m.x, 10_000.0);
        assert!(truth.at(at(9_999)).is_none() && truth.at(at(10_021)).is_none());
        truth.push(at(11_015), pose(0.0));
        assert!(truth.at(at(10_012)).is_none(), "older than a second");
        // The clock was set back by an hour.
        truth.push(at(1_000), pose(1.0));
        assert_eq!(truth.newest(), Some(at(1_000)));
    }

    #[test]
    fn cameras_keep_their_phase_and_skip_missed_images() {
        let camera = TagCamera {
            intrinsics: Intrinsics::from_horizontal_fov(64, 48, 1.0),
            ..webcams(1).remove(0)
        };
        let sensor = Sensor { rate_hz: 50.0, phase: 0.25, exposure_s: 0.004, ..Sensor::default() };
        let mut camera = SimulatedCamera::new(camera, sensor);
        let mut truth = Truth::default();
        let mut stamps = Vec::new();
        for tick in 0..400u64 {
            let stamp = HostTime::from_ns(7_000_000_000 + tick * 2_500_000);
            truth.push(stamp, pose(1.0));
            if (100..200).contains(&tick) {
                continue;
            }
            while let Some((at, _)) = camera.expose(&truth, &[cube()], tick == 200) {
                assert!(at <= stamp);
                stamps.push(at.as_ns());
            }
        }
        assert!(stamps.iter().all(|ns| (ns + 15_000_000) % 20_000_000 == 0), "{stamps:?}");
        let gaps: Vec<u64> = stamps.windows(2).map(|w| (w[1] - w[0]) / 1_000_000).collect();
        assert_eq!(gaps.iter().filter(|&&gap| gap != 20).count(), 1, "{gaps:?}");
        assert!(stamps.len() > 35);
    }

    #[test]
    fn tags_of_the_cube_are_upright_and_valid() {
        cube().validate().unwrap();
        for tag in &cube().tags[..4] {
            assert!((tag.rotation_xyzw * DVec3::Y - DVec3::Z).length() < 1e-12);
            // The tag faces outwards.
            assert!(tag.normal().dot(tag.position_m) > 0.09);
        }
    }
}
