//! Pose of the vehicle from camera images. Sans-IO.
//!
//! Input: grey images of one or more cameras, with the time of exposure. Output: the vehicle's pose at the newest of
//! these times with its covariance, or the reason why there is none; and the detections of each camera, for the live
//! view. Called once per set of images, 30 to 120 times per second.
//!
//! - [`config`]: file that lists cameras and layouts
//! - [`outcome`]: result of a set of images
//! - [`region`]: expected region of tags in an image, from the predicted pose of the vehicle
//! - [`room`]: checks whether a camera in the room still sees the room's tags at their expected positions
//! - [`track`]: motion of the vehicle, and both solutions if the corners are ambiguous
//! - [`monitor`]: estimates errors of clocks, camera poses and tag sizes, and their effect on the pose
//!
//! Images of different exposure times are combined with the vehicle's motion. Webcams run unsynchronized, and at 2 m/s
//! half an image interval is 3 cm.

mod config;
mod monitor;
mod outcome;
mod region;
mod room;
mod track;

pub use config::{LocateConfig, LocateSetup, SIMULATED, SensorConfig, SimulatedTruth};
pub use monitor::Finding;
pub use outcome::{CameraResult, LocateOutcome, Located, TagObservation, Unlocated};

use std::collections::{HashMap, VecDeque};

use glam::{DAffine3, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;

use crate::camera::{Mounting, TagCamera};
use crate::detect::{Detector, DetectorSettings};
use crate::detection::Detection;
use crate::family::TagFamily;
use crate::image::Gray;
use crate::layout::{LayoutFrame, Tag, TagLayout};
use crate::solve::{self, Geometry, Sighting, Solved};
use monitor::{Linear, Monitor};
use region::{Expected, project_tag, sees};
use track::Track;

/// Settings of a locator, apart from tags and cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct LocateSettings {
    pub detector: DetectorSettings,
    /// Standard deviation of a detected corner. [px]
    pub corner_sigma_px: f64,
    /// Maximum root mean square reprojection error. Poses above it are rejected, because a layout, a lens or a camera's
    /// pose is wrong. [px]
    pub most_rms_px: f64,
    /// The maximum tilt of the vehicle: rejects inverted poses. [rad]
    pub most_tilt_rad: f64,
    /// Position uncertainty from print, survey and lens, independent of the corners; added to the covariance. [m]
    pub floor_m: f64,
    /// Rotation uncertainty from print, survey and lens. [rad]
    pub floor_rad: f64,
    /// Maximum age difference between combined images. [s]
    pub most_lag_s: f64,
}

impl Default for LocateSettings {
    fn default() -> Self {
        Self {
            detector: DetectorSettings::default(),
            corner_sigma_px: 0.12,
            most_rms_px: 3.0,
            most_tilt_rad: 1.1,
            floor_m: 0.0002,
            floor_rad: 0.002,
            most_lag_s: 0.075,
        }
    }
}

/// Why a locator cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LocateError {
    /// No camera, or no layout.
    #[error("{0} cameras and {1} layouts: give at least one of each")]
    Nothing(usize, usize),
    /// A camera without a pose.
    #[error(
        "camera {0:?} has neither world_from_cam nor body_from_cam; `vizflyt tags survey` determines it"
    )]
    Unmounted(String),
    /// A tag that is in two layouts.
    #[error("tag {1} of {0} is in two layouts; print each once")]
    Twice(TagFamily, u32),
    /// No camera can use the tags of the layouts.
    #[error("{0}")]
    Useless(&'static str),
}

/// An image with its time of exposure.
#[derive(Clone, Copy, Debug)]
pub struct StampedImage<'a> {
    /// Index of the camera.
    pub camera: usize,
    /// Middle of the exposure.
    pub stamp: HostTime,
    /// The image, in the size of the camera's intrinsics.
    pub image: &'a Gray,
}

/// Locates one vehicle.
pub struct Locator {
    stations: Vec<CameraState>,
    tags: HashMap<(TagFamily, u32), (LayoutFrame, Tag)>,
    detector: Detector,
    track: Track,
    monitor: Monitor,
    /// Mean position of the tags that cameras look at: the centre of their scale. [m, body or world]
    middle_m: DVec3,
    settings: LocateSettings,
}

struct CameraState {
    camera: TagCamera,
    /// Detections of the latest images, the newest last, with the original stamps.
    kept: VecDeque<(HostTime, Vec<Detection>)>,
    /// Number of images since the last detected tag.
    misses: u32,
    /// Time of the last check of the room's tags.
    room_seen: Option<HostTime>,
}

impl Locator {
    /// Makes a locator. Views refer to `cameras` by index.
    ///
    /// # Errors
    /// See [`LocateError`].
    pub fn new(
        cameras: Vec<TagCamera>,
        layouts: &[TagLayout],
        settings: LocateSettings,
    ) -> Result<Self, LocateError> {
        if cameras.is_empty() || layouts.is_empty() {
            return Err(LocateError::Nothing(cameras.len(), layouts.len()));
        }
        let mut tags = HashMap::new();
        for layout in layouts {
            for tag in &layout.tags {
                if tags.insert((tag.family, tag.id), (layout.frame, *tag)).is_some() {
                    return Err(LocateError::Twice(tag.family, tag.id));
                }
            }
        }
        let (mut fixed, mut carried) = (false, false);
        for camera in &cameras {
            match camera.mounting {
                Mounting::World(_) => fixed = true,
                Mounting::Body(_) => carried = true,
                Mounting::Unknown => return Err(LocateError::Unmounted(camera.name.clone())),
            }
        }
        let on_vehicle = layouts.iter().any(|layout| layout.frame == LayoutFrame::Body);
        let in_room = layouts.iter().any(|layout| layout.frame == LayoutFrame::World);
        if !(fixed && on_vehicle || carried && in_room) {
            return Err(LocateError::Useless(if fixed {
                "the cameras are fixed in the room and so are the tags; add the layout of the cube on the vehicle"
            } else {
                "the cameras are on the vehicle and so are the tags; add the surveyed layout of the room"
            }));
        }
        let mut families: Vec<TagFamily> = tags.keys().map(|&(family, _)| family).collect();
        families.sort_unstable();
        families.dedup();
        let detector = Detector::new(&families, settings.detector.clone());
        let stations: Vec<CameraState> = cameras
            .into_iter()
            .map(|camera| CameraState { camera, kept: VecDeque::new(), misses: 0, room_seen: None })
            .collect();
        let frame = if on_vehicle { LayoutFrame::Body } else { LayoutFrame::World };
        let looked_at =
            tags.values().filter(|(of, _)| *of == frame).map(|(_, tag): &(_, Tag)| tag.position_m);
        let middle_m = looked_at.clone().sum::<DVec3>() / looked_at.count() as f64;
        let place_sigma =
            |station: &CameraState| match (&station.camera.survey, station.camera.mounting) {
                (None, Mounting::Body(_)) => (CARRIED_M, CARRIED_RAD),
                (survey, _) => {
                    let sigma_m = survey.as_ref().map_or(UNSURVEYED_M, |survey| {
                        SURVEY_SIGMAS * survey.sigma_m.max(LEAST_SURVEY_M) / 3f64.sqrt()
                    });
                    (sigma_m, sigma_m / ARM_M)
                }
            };
        // If only tags in the room are used, they define the scale, so their size cannot be estimated.
        let is_measure = !(fixed && on_vehicle);
        let places = stations.iter().map(place_sigma).collect::<Vec<_>>();
        let monitor = Monitor::new(&places, is_measure);
        let track = Track::default();
        Ok(Self { stations, tags, detector, track, monitor, middle_m, settings })
    }

    /// Returns errors found in the lab's setup.
    pub fn findings(&self) -> Vec<Finding> {
        let places: Vec<DAffine3> = self
            .stations
            .iter()
            .map(|station| match station.camera.mounting {
                Mounting::World(Pose { rotation, translation_m, .. })
                | Mounting::Body(Pose { rotation, translation_m, .. }) => {
                    DAffine3::from_rotation_translation(rotation, translation_m)
                }
                Mounting::Unknown => DAffine3::IDENTITY,
            })
            .collect();
        self.monitor.findings(&places)
    }

    /// Returns the cameras in the order of their indices.
    pub fn cameras(&self) -> impl ExactSizeIterator<Item = &TagCamera> {
        self.stations.iter().map(|station| &station.camera)
    }

    /// Processes images of one or more cameras, at most one per camera, exposed at nearly the same time.
    ///
    /// # Panics
    /// If `views` is empty, a camera index is out of range, or an image does not have the size of the camera's
    /// intrinsics.
    pub fn handle_images(&mut self, views: &[StampedImage]) -> LocateOutcome {
        let exposed = views.iter().map(|view| self.exposed(view.camera, view.stamp));
        let stamp = exposed.max().expect("there is a view");
        let mut expected =
            self.track.predict(stamp).map(|pose| (pose, self.track.uncertainty_m(stamp)));
        let mut looks = Vec::with_capacity(views.len());
        for view in views {
            self.look_at_room(view);
            looks.push(self.look(view, expected.as_ref()));
            if expected.is_none() && looks.iter().any(|look: &CameraResult| !look.seen.is_empty()) {
                // After one camera has found the vehicle, the others look in the expected region.
                let (sightings, _) = self.sightings(stamp);
                let motion = self.track.motion(stamp).unwrap_or_default();
                if let Some(solved) = solve::solve(&sightings, &motion, None)
                    && solved.other.is_none()
                    && solved.best.rms_px <= self.settings.most_rms_px
                {
                    expected = Some((solved.best.world_from_body, region::FOUND_UNCERTAINTY_M));
                }
            }
        }
        let located = self.locate(stamp, &looks);
        if let Ok(located) = &located {
            for look in &mut looks {
                self.expect(look, located);
            }
        }
        LocateOutcome { located, looks }
    }

    fn look(
        &mut self,
        view: &StampedImage,
        expected: Option<&(Pose<World, Body>, f64)>,
    ) -> CameraResult {
        let is_seen_elsewhere = self.is_seen_elsewhere(view);
        let station = &mut self.stations[view.camera];
        let k = station.camera.intrinsics;
        let size = (view.image.width_px(), view.image.height_px());
        assert_eq!(size, (k.width_px, k.height_px), "images have the size of their intrinsics");
        let expected = expected.map_or(Expected::Unknown, |(pose, uncertainty_m)| {
            let tags =
                self.tags.values().filter(|(frame, _)| sees(&station.camera.mounting, *frame));
            region::expect(&station.camera, tags.map(|(_, tag)| tag), pose, *uncertainty_m)
        });
        // If no tag is found, the whole image is searched, but rarely: the view may be blocked. No search if another
        // camera sees the vehicle: then the region is right, and a search of this image (140 ms at full resolution)
        // would only delay the other camera.
        let search = match expected {
            Expected::Unknown => true,
            Expected::OutOfView => false,
            Expected::Within(_) => !is_seen_elsewhere && station.misses % 7 == 2,
        };
        let (region, found) = if search {
            // Every second search is at full resolution: it finds tags of half the size, in four times the time.
            let fine = station.misses % 2 == 1;
            (None, self.detector.search(view.image, &k, fine))
        } else if let Expected::Within(region) = expected {
            (Some(region), self.detector.look(view.image, &region, &k))
        } else {
            (None, Vec::new())
        };
        let usable = |tag: &Detection| {
            self.tags
                .get(&(tag.family, tag.id))
                .is_some_and(|(frame, _)| sees(&station.camera.mounting, *frame))
        };
        let (known, strangers): (Vec<Detection>, Vec<Detection>) =
            found.into_iter().partition(usable);
        station.misses = if known.is_empty() { station.misses.wrapping_add(1) } else { 0 };
        if station.kept.back().is_none_or(|(kept, _)| *kept <= view.stamp) {
            station.kept.push_back((view.stamp, known.clone()));
            if station.kept.len() > MAX_KEPT {
                station.kept.pop_front();
            }
        }
        let seen = known
            .into_iter()
            .map(|detection| TagObservation { detection, expected_px: None })
            .collect();
        let out_of_view = expected == Expected::OutOfView;
        let StampedImage { camera, stamp, .. } = *view;
        CameraResult { camera, stamp, region, out_of_view, seen, strangers }
    }

    /// Returns whether another camera saw the vehicle recently, in its newest image.
    fn is_seen_elsewhere(&self, view: &StampedImage) -> bool {
        self.stations.iter().enumerate().any(|(index, station)| {
            let newest = station.kept.back().filter(|_| index != view.camera);
            newest.is_some_and(|(at, tags)| {
                !tags.is_empty() && view.stamp.seconds_since(*at).abs() < SEEN_LATELY_S
            })
        })
    }

    /// Returns the exposure time of an image with this stamp.
    fn exposed(&self, camera: usize, stamp: HostTime) -> HostTime {
        stamp.plus_seconds(-self.monitor.correction(camera).late_s)
    }

    /// Returns the detections of all cameras around an instant, and the camera of each.
    fn sightings(&self, stamp: HostTime) -> (Vec<Sighting<'_>>, Vec<usize>) {
        let (mut all, mut cameras) = (Vec::new(), Vec::new());
        let scale = self.monitor.scale();
        for (index, station) in self.stations.iter().enumerate() {
            let wrong = self.monitor.correction(index);
            let lag_s = |at: HostTime| stamp.seconds_since(self.exposed(index, at));
            // The newest image up to the instant and the first one after it: errors of the motion in between cancel
            // out.
            let before = station.kept.iter().rfind(|(at, _)| lag_s(*at) >= 0.0);
            let after = station.kept.iter().find(|(at, _)| lag_s(*at) < 0.0);
            let near = before.into_iter().chain(after).map(|(at, tags)| (lag_s(*at), tags));
            let near = near.filter(|(lag_s, _)| lag_s.abs() <= self.most_lag_s(stamp));
            let seen =
                near.flat_map(|(lag_s, tags)| tags.iter().map(move |tag| (lag_s, tags, tag)));
            for (lag_s, tags, tag) in seen {
                let Some((_, placed)) = self.tags.get(&(tag.family, tag.id)) else { continue };
                let position_m = self.middle_m + scale * (placed.position_m - self.middle_m);
                let size_m = scale * placed.size_m;
                let placed = Tag { size_m, position_m, ..*placed };
                let sight = match station.camera.mounting {
                    Mounting::World(world_from_cam) => Geometry::OutsideIn {
                        world_from_cam: wrong.apply(&world_from_cam),
                        body_from_tag: placed.frame_from_tag(),
                    },
                    Mounting::Body(body_from_cam) => Geometry::InsideOut {
                        body_from_cam: wrong.apply(&body_from_cam),
                        world_from_tag: placed.frame_from_tag(),
                    },
                    Mounting::Unknown => continue,
                };
                // An error of the motion shifts all corners together: all corners give as much information as one,
                // hence the factor sqrt(corners).
                let edge_px = tag.corners_px[0].distance(tag.corners_px[2]) / 2f64.sqrt();
                let px_per_m = edge_px / placed.size_m;
                let corners = (4 * tags.len()) as f64;
                let carried_m = lag_s.abs() * SPEED_UNCERTAINTY_MPS
                    + 0.5 * lag_s * lag_s * ACCELERATION_UNCERTAINTY_MPS2;
                let carried_px = carried_m * px_per_m * corners.sqrt();
                let sigma_px = self.settings.corner_sigma_px.hypot(carried_px);
                all.push(Sighting {
                    camera: &station.camera.intrinsics,
                    sight,
                    size_m: placed.size_m,
                    corners_px: tag.corners_px,
                    sigma_px,
                    lag_s,
                    readout_s: wrong.readout_s,
                });
                cameras.push(index);
            }
        }
        (all, cameras)
    }

    /// Returns the maximum time difference between combined images. [s]
    fn most_lag_s(&self, stamp: HostTime) -> f64 {
        // With unknown motion, only images of the same exposure can be combined.
        if self.track.motion(stamp).is_some() { self.settings.most_lag_s } else { TOGETHER_S }
    }

    fn locate(&mut self, stamp: HostTime, looks: &[CameraResult]) -> Result<Located, Unlocated> {
        if looks.iter().all(|look| look.seen.is_empty()) {
            return Err(Unlocated::NoTag);
        }
        let is_old = self.track.newest().is_some_and(|newest| stamp <= newest);
        let (mut sightings, mut cameras) = self.sightings(stamp);
        let expected = self.track.predict(stamp);
        let motion = self.track.motion(stamp).unwrap_or_default();
        let middle_m = self.middle_m;
        let linear = |sightings: &[Sighting], cameras: &[usize], solved: &Solved| {
            Linear::at(sightings, cameras, &motion, &solved.best.world_from_body, middle_m)
        };
        let most_off = sightings.len() / 3;
        let mut off = 0;
        let mut solved = solve::solve(&sightings, &motion, expected.as_ref());
        // Corners that fit no pose still show what is wrong.
        let learnt = solved.as_ref().filter(|solved| solved.other.is_none());
        let learnt = learnt.and_then(|solved| linear(&sightings, &cameras, solved));
        let solved = loop {
            let Some(found) = &solved else { break Err(Unlocated::NoPose) };
            if found.best.rms_px <= self.settings.most_rms_px {
                break Ok(*found);
            }
            // A few tags that do not fit are misread or have been moved: continue without them.
            let pose = &found.best.world_from_body;
            let worst = sightings
                .iter()
                .map(|sighting| solve::residual_px(sighting, &motion, pose))
                .enumerate()
                .max_by(|a, b| a.1.total_cmp(&b.1));
            match worst {
                Some((index, _)) if off < most_off => {
                    sightings.swap_remove(index);
                    cameras.swap_remove(index);
                }
                _ => break Err(Unlocated::Residuals(found.best.rms_px)),
            }
            off += 1;
            solved = solve::solve(&sightings, &motion, expected.as_ref());
        };
        let tags = sightings.len();
        let spread = solved
            .as_ref()
            .ok()
            .and_then(|solved| linear(&sightings, &cameras, solved))
            .map_or([[0.0; 6]; 6], |set| self.monitor.spread(&set));
        cameras.sort_unstable();
        cameras.dedup();
        if let Some(set) = learnt {
            self.monitor.learn(stamp, &set, &motion);
            self.monitor.judge(stamp);
        }
        if is_old {
            // Late images of one camera lie between two images of another and improve the motion estimate.
            if let Ok(Solved { best, other: None }) = solved {
                self.track.insert(stamp, &best);
            }
            return Err(Unlocated::Old);
        }
        let mut fit = self
            .track
            .update(stamp, &solved?, self.settings.most_tilt_rad)
            .ok_or(Unlocated::Ambiguous)?;
        for (row, spread) in fit.covariance.iter_mut().zip(spread) {
            for (value, spread) in row.iter_mut().zip(spread) {
                *value += spread;
            }
        }
        let (sigma_m, sigma_rad) = fit.sigmas();
        let floored = |sigma: DVec3, floor: f64| {
            DVec3::new(sigma.x.hypot(floor), sigma.y.hypot(floor), sigma.z.hypot(floor))
        };
        Ok(Located {
            stamp,
            world_from_body: fit.world_from_body,
            position_sigma_m: floored(sigma_m, self.settings.floor_m),
            rotation_sigma_rad: floored(sigma_rad, self.settings.floor_rad),
            covariance: fit.covariance,
            tags,
            cameras: cameras.len(),
            rms_px: fit.rms_px,
        })
    }

    /// Sets the expected corners of the detections from the pose.
    fn expect(&self, look: &mut CameraResult, located: &Located) {
        let camera = &self.stations[look.camera].camera;
        let lag_s = located.stamp.seconds_since(self.exposed(look.camera, look.stamp));
        let motion = self.track.motion(located.stamp).unwrap_or_default();
        let pose = motion.carry(&located.world_from_body, -lag_s);
        for seen in &mut look.seen {
            let key = (seen.detection.family, seen.detection.id);
            let Some((_, tag)) = self.tags.get(&key) else { continue };
            seen.expected_px = project_tag(camera, tag, &pose, 1.0);
        }
    }
}

/// Maximum age of another camera's detection that makes the track trustworthy: three images of a slow webcam. [s]
const SEEN_LATELY_S: f64 = 0.2;
/// Exposures closer than this are treated as simultaneous. [s]
const TOGETHER_S: f64 = 0.001;
/// Position sigma per axis of a camera in the room without a survey. [m]
const UNSURVEYED_M: f64 = 0.001;
/// Position sigma per axis of a camera on the vehicle without a survey. A ruler places it within 1.5 mm. The value is
/// larger because this error is constant, and filters of these poses treat it as noise, which averages out. [m]
const CARRIED_M: f64 = 0.0019;
/// Rotation sigma of a camera on the vehicle without a survey. The mat's own level aligns it within 1.5 mrad. [rad]
const CARRIED_RAD: f64 = 0.0019;
/// Lever arm that converts a position sigma of a camera into a rotation sigma. [m]
const ARM_M: f64 = 3.0;
/// Factor on a survey's sigma, for errors that all its corners share.
const SURVEY_SIGMAS: f64 = 1.0;
/// Minimum sigma of a survey: camera stands are not more stable. [m]
const LEAST_SURVEY_M: f64 = 0.0002;
/// Number of images kept per camera. Late images of other cameras lie between two of them.
const MAX_KEPT: usize = 4;
/// Uncertainty of the vehicle's estimated velocity. [m/s]
const SPEED_UNCERTAINTY_MPS: f64 = 0.02;
/// Uncertainty of the vehicle's estimated acceleration. [m/s^2]
const ACCELERATION_UNCERTAINTY_MPS2: f64 = 2.0;

#[cfg(test)]
mod tests;
