//! From images to the vehicle's pose. Sans-IO.
//!
//! What enters: grey images with the instant of their exposure, as many cameras at once as have one. What
//! leaves: the vehicle's pose at the newest of these instants with its covariance, or why there is none;
//! and what was seen where, for the live view. Called once per set of images, 30 to 120 times a second.
//!
//! - [`config`]: the file that names cameras and layouts;
//! - [`outcome`]: what comes of a set of images;
//! - [`region`]: where tags should be in an image, by where the vehicle should be;
//! - [`room`]: whether tags of the room are where a camera in the room had them;
//! - [`track`]: how the vehicle moves, and both answers where corners leave two open;
//! - [`monitor`]: what is wrong with clocks, cameras' places and tags' sizes, and what that leaves open of the pose.
//!
//! Cameras that were not exposed together are carried to one instant by the vehicle's motion: webcams
//! run free, and at 2 m/s half an image's interval is 3 cm.

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

/// What locating needs to know beside tags and cameras; the defaults serve.
#[derive(Clone, Debug, PartialEq)]
pub struct LocateSettings {
    /// How tags are looked for.
    pub detector: DetectorSettings,
    /// How far a corner may be off, one standard deviation. [px]
    pub corner_sigma_px: f64,
    /// Poses that leave corners further off than this are refused: a layout, a lens or a camera's place is
    /// wrong. Root mean square. [px]
    pub most_rms_px: f64,
    /// The maximum tilt of the vehicle: rejects inverted poses. [rad]
    pub most_tilt_rad: f64,
    /// Uncertainty of print, survey and lens, independent of the corners; added to the covariance. [m]
    pub floor_m: f64,
    /// Likewise. [rad]
    pub floor_rad: f64,
    /// Images of other cameras are used up to this long after their exposure. [s]
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
    #[error("{0} cameras and {1} layouts: give one of each at least")]
    Nothing(usize, usize),
    /// A camera whose place is not known.
    #[error(
        "camera {0:?} has neither world_from_cam nor body_from_cam; `vizflyt tags survey` finds it"
    )]
    Unmounted(String),
    /// A tag that is in two layouts.
    #[error("tag {1} of {0} is in two layouts; print each once")]
    Twice(TagFamily, u32),
    /// Tags that no camera can use.
    #[error("{0}")]
    Useless(&'static str),
}

/// An image and when it was exposed.
#[derive(Clone, Copy, Debug)]
pub struct StampedImage<'a> {
    /// Index of the camera.
    pub camera: usize,
    /// Middle of the exposure.
    pub stamp: HostTime,
    /// What it saw, in the size of the camera's intrinsics.
    pub image: &'a Gray,
}

/// Locates one vehicle.
pub struct Locator {
    stations: Vec<CameraState>,
    tags: HashMap<(TagFamily, u32), (LayoutFrame, Tag)>,
    detector: Detector,
    track: Track,
    monitor: Monitor,
    /// Middle of the tags that cameras look at: what they grow about. [m, body or world]
    middle_m: DVec3,
    settings: LocateSettings,
}

struct CameraState {
    camera: TagCamera,
    /// What it saw in its last images, the newest last, by the stamps that came with them.
    kept: VecDeque<(HostTime, Vec<Detection>)>,
    /// Images since it last saw a tag.
    misses: u32,
    /// When it was last looked whether tags of the room are where they were.
    room_seen: Option<HostTime>,
}

impl Locator {
    /// Makes a locator of these cameras, whose indices views have, and tags.
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
        // Tags of the room alone are the room's only measure: nothing is larger or smaller than they say.
        let is_measure = !(fixed && on_vehicle);
        let places = stations.iter().map(place_sigma).collect::<Vec<_>>();
        let monitor = Monitor::new(&places, is_measure);
        let track = Track::default();
        Ok(Self { stations, tags, detector, track, monitor, middle_m, settings })
    }

    /// Returns what is found to be wrong with the lab.
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

    /// Returns the cameras, in the order of their indices.
    pub fn cameras(&self) -> impl ExactSizeIterator<Item = &TagCamera> {
        self.stations.iter().map(|station| &station.camera)
    }

    /// Takes images of one or more cameras, at most one of each, exposed at nearly the same time.
    ///
    /// # Panics
    /// If there is no view, a camera has no such index, or an image is not of the camera's size.
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
                // Found by one camera, it is looked for in the right place by the others.
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
        // Where it is not found, the whole image is searched, but seldom: something is in the way. Not while
        // another camera sees the vehicle: then the place is right, and a search of this image (140 ms at
        // every pixel) would only hold up the other's.
        let search = match expected {
            Expected::Unknown => true,
            Expected::OutOfView => false,
            Expected::Within(_) => !is_seen_elsewhere && station.misses % 7 == 2,
        };
        let (region, found) = if search {
            // Every other search is a fine one: it finds tags half as large, in four times the time.
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

    /// Whether a camera other than this view's saw the vehicle in its newest image, not long ago.
    fn is_seen_elsewhere(&self, view: &StampedImage) -> bool {
        self.stations.iter().enumerate().any(|(index, station)| {
            let newest = station.kept.back().filter(|_| index != view.camera);
            newest.is_some_and(|(at, tags)| {
                !tags.is_empty() && view.stamp.seconds_since(*at).abs() < SEEN_LATELY_S
            })
        })
    }

    /// Returns when an image was exposed that bears a stamp.
    fn exposed(&self, camera: usize, stamp: HostTime) -> HostTime {
        stamp.plus_seconds(-self.monitor.correction(camera).late_s)
    }

    /// Returns what all cameras saw around an instant, and which camera each.
    fn sightings(&self, stamp: HostTime) -> (Vec<Sighting<'_>>, Vec<usize>) {
        let (mut all, mut cameras) = (Vec::new(), Vec::new());
        let scale = self.monitor.scale();
        for (index, station) in self.stations.iter().enumerate() {
            let wrong = self.monitor.correction(index);
            let lag_s = |at: HostTime| stamp.seconds_since(self.exposed(index, at));
            // The newest image up to the instant, and the first one after it: motion in between cancels out.
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
                // What the motion in between may be off moves all corners together: as much is learnt from
                // them all as from one.
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

    /// Returns how far apart in time images are used together. [s]
    fn most_lag_s(&self, stamp: HostTime) -> f64 {
        // What moves in an unknown way is where it was for one exposure only.
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
        // Corners that fit no pose tell why.
        let learnt = solved.as_ref().filter(|solved| solved.other.is_none());
        let learnt = learnt.and_then(|solved| linear(&sightings, &cameras, solved));
        let solved = loop {
            let Some(found) = &solved else { break Err(Unlocated::NoPose) };
            if found.best.rms_px <= self.settings.most_rms_px {
                break Ok(*found);
            }
            // A few tags that do not fit the others are misread, or have moved: without them.
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
            // Of a camera whose images come late: between two of another's they tell the motion well.
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

    /// Fills in where the pose puts the corners.
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

/// Three images of a slow webcam: what one of them saw then is still a reason to trust the track. [s]
const SEEN_LATELY_S: f64 = 0.2;
/// Exposures closer than this are one. [s]
const TOGETHER_S: f64 = 0.001;
/// How far a camera may be off whose file has no survey, along an axis. [m]
const UNSURVEYED_M: f64 = 0.001;
/// And one under a vehicle: 1.5 mm where a ruler has placed it, and more, for it is off in the same way all along, and who
/// filters these poses takes that for noise, which averages out. [m]
const CARRIED_M: f64 = 0.0019;
/// Likewise, of 1.5 mrad where the mat's own level has turned it. [rad]
const CARRIED_RAD: f64 = 0.0019;
/// What turns a camera in the room turns it about something so far away. [m]
const ARM_M: f64 = 3.0;
/// Errors that all its corners share are not in a survey's sigma: so many of it.
const SURVEY_SIGMAS: f64 = 1.0;
/// Nor do stands hold better than this. [m]
const LEAST_SURVEY_M: f64 = 0.0002;
/// Images of a camera that are kept: others' that come late lie between two of them.
const MAX_KEPT: usize = 4;
/// What the vehicle's estimated velocity may be off. [m/s]
const SPEED_UNCERTAINTY_MPS: f64 = 0.02;
/// And its acceleration. [m/s^2]
const ACCELERATION_UNCERTAINTY_MPS2: f64 = 2.0;

#[cfg(test)]
mod tests;
