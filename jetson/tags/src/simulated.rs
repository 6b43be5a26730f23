//! Simulated webcams: where the vehicle truly is goes in, images with the instant of their exposure come
//! out. Sans-IO.
//!
//! [`Truth`] keeps the vehicle's true poses of the last second, as they arrive; [`SimulatedCamera`] renders an
//! image once the truth reaches past the end of its exposure. Cameras run free, each with its own phase,
//! as webcams do. The lab's two setups are here: webcams in the room and a [`cube`] on the vehicle, and [`over_mat`] a
//! webcam under the vehicle.

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

/// The vehicle's true poses, of the last second.
#[derive(Clone, Debug, Default)]
pub struct Truth {
    past: VecDeque<(HostTime, Pose<World, Body>)>,
}

impl Truth {
    /// Takes a pose; one that is not newer than the last is dropped, unless it is so much older that a
    /// clock was set: then all before is forgotten.
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

    /// Returns when the newest pose was true.
    pub fn newest(&self) -> Option<HostTime> {
        self.past.back().map(|(stamp, _)| *stamp)
    }

    /// Returns the pose at an instant; `None` before the first and after the last that is known.
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

/// How a simulated camera takes images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Images a second. [Hz]
    pub rate_hz: f64,
    /// When the first is exposed after a whole second, of the interval between images.
    pub phase: f64,
    /// How long the shutter is open. [s]
    pub exposure_s: f64,
    /// Standard deviation of the optics' blur. [px]
    pub blur_px: f64,
    /// The distance at which the lens is focused. [m]
    pub focus_m: f64,
    /// How wide its opening is: what is elsewhere than in focus is blurred by it; 0 is a pinhole. [m]
    pub aperture_m: f64,
    /// Standard deviation of the sensor's noise. [grey levels of 255]
    pub noise: f64,
    /// How bright things appear.
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

/// A camera that sees tags where the true pose puts them.
#[derive(Debug)]
pub struct SimulatedCamera {
    camera: TagCamera,
    renderer: Renderer,
    sensor: Sensor,
    /// Counts the intervals since the clock's zero.
    next: Option<u64>,
    behind: Option<Background>,
}

/// Renders what is behind the tags for a camera that stands somewhere, an image of its own size.
pub struct Background(Box<RenderBackground>);

type RenderBackground = dyn FnMut(&Pose<World, Cam>) -> Gray + Send;

impl Background {
    /// Renders by calling this.
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
    /// Makes a camera.
    pub fn new(camera: TagCamera, sensor: Sensor) -> Self {
        let renderer = Renderer::new(camera.intrinsics);
        Self { camera, renderer, sensor, next: None, behind: None }
    }

    /// Makes a camera that sees a place behind the tags instead of a cluttered wall.
    #[must_use]
    pub fn before(camera: TagCamera, sensor: Sensor, behind: Background) -> Self {
        Self { behind: Some(behind), ..Self::new(camera, sensor) }
    }

    /// Returns the camera.
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
        // What was missed is not made up for.
        let earliest = (first.plus_seconds(half_s).as_ns() as f64 * 1e-9 / interval_s
            - self.sensor.phase)
            .ceil()
            .max(0.0) as u64;
        let next = self.next.map_or(earliest, |next| {
            // After a clock was set, from there.
            let latest = (newest.as_ns() as f64 * 1e-9 / interval_s).ceil() as u64 + 1;
            if next > latest { earliest } else { next.max(earliest) }
        });
        self.next = Some(next);
        let stamp = middle(next);
        (stamp.plus_seconds(half_s) <= newest).then_some(stamp)
    }

    /// Renders the image that is [due](Self::due); `None` if none is. `latest` leaves out all but the newest
    /// of several that are.
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

    /// Returns the blur of a lens that is focused elsewhere, one standard deviation, at the tag that is nearest. [px]
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
        // A disc has a deviation of a quarter of its diameter along an axis.
        let disc = aperture_m * (nearest_m.recip() - focus_m.recip()).abs();
        0.25 * k.fx_px * disc
    }
}

/// Returns the cube of the simulated lab: 0.25 m, a tag of 0.2 m on each side and on top, as
/// `vizflyt tags print cube --paper a3 --face-mm 250 --tag-mm 200` prints it; it stands on the vehicle's back.
/// In a hall of 11 m smaller tags are too few pixels at its other end.
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

/// Returns one to four webcams of the simulated lab, the netted hall of 11 x 4.5 x 3.65 m (x from 0 to 11,
/// y from -2.25 to 2.25): 1280 x 720, 62 degrees across, distorted as webcams are. The first two hang at
/// the hall's ends in opposite corners, behind the net and under its ceiling.
pub fn webcams(count: usize) -> Vec<TagCamera> {
    let places = [
        ("west", DVec3::new(-0.4, 2.0, 3.3), DVec3::new(5.5, -0.3, 1.0)),
        ("east", DVec3::new(11.4, -2.0, 3.3), DVec3::new(5.5, 0.3, 1.0)),
        ("southwest", DVec3::new(-0.4, -2.0, 3.3), DVec3::new(5.5, 0.3, 1.0)),
        ("northeast", DVec3::new(11.4, 2.0, 3.3), DVec3::new(5.5, -0.3, 1.0)),
    ];
    let made = places.into_iter().take(count).enumerate().map(|(i, (name, from, at))| {
        // No two lenses are alike.
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

/// Returns a camera at a point that looks at another, its right side level.
fn looking(from_m: DVec3, at_m: DVec3) -> Pose<World, Cam> {
    let z = (at_m - from_m).normalize();
    let x = z.cross(DVec3::Z).normalize();
    Pose::new(from_m, DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)))
}

/// How long true poses are kept. [s]
const TRUTH_SPAN_S: f64 = 1.0;
/// Edge of the cube. [m]
const CUBE_M: f64 = 0.25;
/// Edge of its black squares: ten cells of 25 mm make a face, eight of them the square. [m]
const CUBE_TAG_M: f64 = 0.2;
/// Its middle above the vehicle's. [m]
const CUBE_HEIGHT_M: f64 = 0.165;

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: f64) -> Pose<World, Body> {
        Pose::new(DVec3::X * x, DQuat::IDENTITY)
    }

    #[test]
    fn truth_is_interpolated_and_forgotten() {
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
        // A clock that was set back by an hour.
        truth.push(at(1_000), pose(1.0));
        assert_eq!(truth.newest(), Some(at(1_000)));
    }

    #[test]
    fn cameras_run_free_and_never_catch_up() {
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
    fn the_lab_s_tags_are_upright_and_its_layouts_valid() {
        cube().validate().unwrap();
        for tag in &cube().tags[..4] {
            assert!((tag.rotation_xyzw * DVec3::Y - DVec3::Z).length() < 1e-12);
            // Outwards.
            assert!(tag.normal().dot(tag.position_m) > 0.09);
        }
    }
}
