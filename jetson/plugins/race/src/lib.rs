//! Flies a race course from images: windows, a gap, a window with a rotating hand.
//!
//! It has no map and no position: only camera images and the attitude. Steps at every image:
//! 1. [`sampling`]: convert pixels to vectors and colour classes (bars of known windows), [`color_class`];
//! 2. [`odometry`]: estimate the camera's position by registering its depth to an earlier image;
//! 3. [`plane_detection`]: detect new windows by their colour, walls by their size;
//! 4. [`planar_obstacle`]: find solid and free cells of each, and the widest place of its opening; [`known`] stores the
//!    obstacles and selects the next one;
//! 5. [`hand`]: estimate the motion of the hand in that opening, and when the way is clear;
//! 6. [`steer`]: fly through the opening of the nearest obstacle, clear of everything solid.
//!
//! All positions are in the frame [`sampling::Home`], so that windows outside the image are not lost.

pub mod color_class;
pub mod hand;
pub mod known;
pub mod odometry;
pub mod planar_obstacle;
pub mod plane_detection;
pub mod sampling;
pub mod steer;
#[cfg(test)]
mod test_scene;

use std::f64::consts::TAU;

use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};
use vizflyt_sdk::protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_sdk::{
    ArenaInfo, Autonomy, Axes, CameraImage, Event, EventKind, Observation, Setpoint, Vehicle,
    YawTarget,
};

use color_class::ColorClass;
use hand::Hand;
use known::{Known, PASSED_M};
use odometry::Odometry;
use planar_obstacle::{ObstacleKind, PlanarObstacle};
use sampling::{PixelGrid, RgbdView};
use steer::Aim;

/// The plugin.
#[derive(Clone, Debug, Default)]
pub struct Race {
    /// Goal of the flight, if the course has one. [m, world]
    goal_m: Option<DVec3>,
    grid: PixelGrid,
    odometry: Odometry,
    /// Rotation from world axes to home axes about z, set by the first image. [rad]
    home_yaw_rad: Option<f64>,
    known: Known,
    hand: Hand,
    /// Obstacle that the vehicle flies through next.
    target: Option<ObstacleKind>,
    /// Start of the passage. During a passage the target does not change. [s]
    committed_s: Option<f64>,
    /// Start of the search, if no obstacle is known. [s]
    searching_s: Option<f64>,
    /// Last returned velocity. [m/s, home]
    setpoint_mps: DVec3,
    /// Whether an image had depth, and the number of images without depth before.
    has_depth: bool,
    without_depth: u32,
    /// Number of the last processed image.
    seen: Option<u64>,
    last_s: Option<f64>,
    finished: bool,
}

impl Autonomy for Race {
    fn on_start(&mut self, info: &ArenaInfo) {
        *self = Self { goal_m: info.goal_m, ..Self::default() };
    }

    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        let vehicle = obs.vehicle()?;
        let camera = obs.camera("front").or_else(|| obs.cameras().next())?;
        if !(vehicle.attitude.is_finite() && vehicle.attitude.is_normalized()) {
            return None;
        }
        // An image of another camera has arrived; this one is already processed.
        if self.seen.replace(camera.seq) == Some(camera.seq) {
            return None;
        }
        if !self.has_depth(&camera) {
            return None;
        }
        Some(self.decide(&vehicle, &camera))
    }

    fn on_event(&mut self, event: &Event) {
        if matches!(event.kind, EventKind::Finished { .. }) {
            self.finished = true;
        }
    }
}

/// Position of the vehicle by its own estimate.
#[derive(Clone, Copy, Debug)]
pub struct Here {
    /// Position of the body. [m, home]
    pub p_m: DVec3,
    /// Position of the camera. [m, home]
    pub camera_m: DVec3,
    /// Goal of the course, if the course gives the goal and the vehicle's pose. [m, home]
    pub goal_m: Option<DVec3>,
}

impl Race {
    /// Returns the estimated position of the camera. [m, home]
    pub fn here_m(&self) -> DVec3 {
        self.odometry.p_m
    }

    /// Returns the detected obstacles.
    pub fn known(&self) -> &Known {
        &self.known
    }

    /// Returns the obstacle that the vehicle flies through next.
    pub fn target(&self) -> Option<ObstacleKind> {
        self.target
    }

    /// Returns the rotation of the hand, once it is estimated.
    pub fn hand(&self) -> Option<&hand::HandRotation> {
        self.hand.motion()
    }

    /// Returns whether images contain depth. Until one does, the plugin returns no setpoint and the vehicle stays on
    /// the ground.
    ///
    /// # Panics
    /// If there is no depth for 1 s. The runtime reports this message, because the plugin cannot fly here.
    fn has_depth(&mut self, camera: &CameraImage<'_>) -> bool {
        self.has_depth |= camera.depth_mm.iter().any(|&depth_mm| depth_mm > 0);
        self.without_depth += u32::from(!self.has_depth);
        assert!(
            self.has_depth || self.without_depth < PATIENCE,
            "race needs depth, but this course's level has only colour (g); fly it with --level ug"
        );
        self.has_depth
    }

    fn decide(&mut self, vehicle: &Vehicle, camera: &CameraImage<'_>) -> Setpoint {
        let now_s = camera.shown.as_ns() as f64 * 1e-9;
        let dt_s = self.last_s.map_or(0.0, |last_s| now_s - last_s).clamp(0.0, MAX_DT_S);
        self.last_s = Some(now_s);
        let here = self.look(now_s, vehicle, camera);
        if self.finished {
            return Setpoint::Hold;
        }
        let settled = self.target.filter(|_| self.committed_s.is_some());
        self.known.update(now_s, here.camera_m, &self.grid, settled);
        let (wanted_mps, look_rad) = self.choose(now_s, &here);
        let solid = self.known.obstacles().iter();
        let wanted_mps = steer::clear_of(wanted_mps, here.p_m, solid).clamp_length_max(MAX_MPS);
        // Before take-off the vehicle does not follow the setpoint, so limit their difference.
        let from_mps = self.odometry.v_mps
            + (self.setpoint_mps - self.odometry.v_mps).clamp_length_max(MAX_LEAD_MPS);
        self.setpoint_mps = from_mps + (wanted_mps - from_mps).clamp_length_max(SLEW_MPS2 * dt_s);
        let home_yaw_rad = self.home_yaw_rad.unwrap_or(0.0);
        let heading_from_home = DQuat::from_rotation_z(home_yaw_rad - yaw_of(vehicle.attitude));
        Setpoint::Velocity {
            v_mps: heading_from_home * self.setpoint_mps,
            axes: Axes::Heading,
            yaw: YawTarget::Angle(wrap_pi(look_rad + home_yaw_rad)),
        }
    }

    /// Processes an image, and returns the position from which it was taken.
    fn look(&mut self, now_s: f64, vehicle: &Vehicle, camera: &CameraImage<'_>) -> Here {
        // The attitude is some milliseconds newer or older than the image; extrapolate with constant angular velocity.
        let ahead_s = camera.shown.seconds_since(vehicle.stamp).clamp(-MAX_DT_S, MAX_DT_S);
        let turned = DQuat::from_scaled_axis(vehicle.omega_body_radps * ahead_s);
        let world_from_body = (vehicle.attitude * turned).normalize();
        let home_yaw_rad = *self.home_yaw_rad.get_or_insert_with(|| yaw_of(world_from_body));
        let home_from_body = DQuat::from_rotation_z(-home_yaw_rad) * world_from_body;
        let home_from_cam = home_from_body * camera.body_from_cam.rotation;
        self.grid.update(&RgbdView {
            rgb: camera.rgb,
            depth_mm: camera.depth_mm,
            intrinsics: camera.intrinsics,
            home_from_cam,
        });
        self.odometry.update(now_s, &mut self.grid);
        let camera_m = self.odometry.p_m;
        let p_m = camera_m - home_from_body * camera.body_from_cam.translation_m;
        Here {
            p_m,
            camera_m,
            goal_m: self.goal_m.zip(vehicle.world_from_body).map(|(goal_m, world_from_body)| {
                let from_body_m = goal_m - world_from_body.translation_m;
                p_m + DQuat::from_rotation_z(-home_yaw_rad) * from_body_m
            }),
        }
    }

    /// Returns a velocity [m/s, home] and the direction of the nose [rad, home].
    fn choose(&mut self, now_s: f64, here: &Here) -> (DVec3, f64) {
        let behind_m =
            |kind| self.known.obstacle(kind).map(|obstacle| obstacle.plane.behind_m(here.p_m));
        if let Some(kind) = self.target.filter(|&kind| behind_m(kind) > Some(PASSED_M)) {
            println!("through {}", kind.name());
            self.known.pass(kind);
            self.target = None;
            self.committed_s = None;
        }
        self.committed_s = self.committed_s.filter(|since_s| now_s - since_s < THROUGH_S);
        if self.committed_s.is_none() {
            self.target = self.known.next(here.p_m, None).map(|obstacle| obstacle.kind);
        }
        let Some(obstacle) = self.target.and_then(|kind| self.known.obstacle(kind)) else {
            return self.search(now_s, here);
        };
        self.searching_s = None;
        let Some(opening) = obstacle.opening else {
            // Fly to a place from which the middle of the obstacle is visible.
            let middle_m = obstacle.plane.point_m(DVec2::new(0.0, VIEW_HEIGHT_M));
            let to_m = middle_m - obstacle.plane.normal() * VIEW_M - here.p_m;
            let look_rad = (middle_m - here.p_m).truncate().to_angle();
            return (to_m.clamp_length_max(VIEW_MPS), look_rad);
        };
        let aim = Aim::from(here.p_m, &obstacle.plane, &opening);
        let mut held = opening.radius_m < WIDE_ENOUGH_M;
        let mut begins = !held && aim.before_m < COMMIT_M && aim.off_m.length() < COMMIT_OFF_M;
        if obstacle.kind == ObstacleKind::Window(ColorClass::Orange) && self.committed_s.is_none() {
            self.hand.update(now_s, &obstacle.hand_m(here.camera_m, &self.grid));
            let there_s = now_s + START_LAG_S + (aim.before_m - 0.2).max(0.0) / steer::CRUISE_MPS;
            let (from_s, to_s) = (there_s - EARLY_S, there_s + LATE_S);
            let within_m = obstacle.plane.within_m(opening.center_m);
            let waits = aim.before_m < steer::WAIT_M + 0.1 && aim.off_m.length() < 0.12;
            begins = !held && waits && self.hand.is_clear(within_m, HAND_ROOM_M, from_s, to_s);
            held = !begins;
        }
        if begins {
            self.committed_s.get_or_insert(now_s);
        }
        let look_rad = if aim.before_m > LOOK_M {
            (opening.center_m - here.p_m).truncate().to_angle()
        } else {
            self.beyond_rad(here, obstacle).unwrap_or(obstacle.plane.yaw_rad)
        };
        (steer::through(&aim, &obstacle.plane, held && self.committed_s.is_none()), look_rad)
    }

    /// Returns the direction of the obstacle after this one. [rad, home]
    fn beyond_rad(&self, here: &Here, obstacle: &PlanarObstacle) -> Option<f64> {
        let next = self.known.next(here.p_m, Some(obstacle.kind))?;
        let middle_m = next.opening.map_or(next.plane.origin_m, |opening| opening.center_m);
        let look_rad = (middle_m - here.p_m).truncate().to_angle();
        Some(look_rad.clamp(-MAX_LOOK_RAD, MAX_LOOK_RAD))
    }

    /// Turns left and right to find an obstacle.
    fn search(&mut self, now_s: f64, here: &Here) -> (DVec3, f64) {
        let since_s = now_s - *self.searching_s.get_or_insert(now_s);
        let last =
            self.known.has_passed(ObstacleKind::Window(ColorClass::Orange)) || since_s > SEARCH_S;
        if let Some(goal_m) = here.goal_m.filter(|_| last && self.known.has_begun()) {
            let to_m = goal_m - here.p_m;
            return ((to_m * GOAL_PER_S).clamp_length_max(steer::CRUISE_MPS), 0.0);
        }
        (DVec3::ZERO, MAX_LOOK_RAD * (TAU * since_s / SEARCH_S).sin())
    }
}

/// Maximum number of images without depth: 1 s. A covered camera has none for a while.
const PATIENCE: u32 = 30;
/// Maximum time step between two images; a longer one is clamped to this value. [s]
const MAX_DT_S: f64 = 0.1;
/// Maximum speed in all directions. [m/s]
const MAX_MPS: f64 = 1.3;
/// Maximum rate of change of the setpoint. Tilts the camera by atan(3.5 / 9.81) = 20 degrees. [m/s^2]
const SLEW_MPS2: f64 = 3.5;
/// Maximum difference of setpoint and velocity: slew times lag is 0.9 m/s, plus a reserve. [m/s]
const MAX_LEAD_MPS: f64 = 1.2;
/// Within this distance to plane and line, the passage begins. [m]
const COMMIT_M: f64 = 0.35;
const COMMIT_OFF_M: f64 = 0.15;
/// A passage that takes longer has failed and starts again: a metre takes 1.4 s. [s]
const THROUGH_S: f64 = 4.0;
/// Minimum radius of an opening: the vehicle with half of its width on each side. [m]
const WIDE_ENOUGH_M: f64 = 0.27;
/// Nearer than this, the opening fills the image, so look at the next obstacle. [m]
const LOOK_M: f64 = 0.45;
const MAX_LOOK_RAD: f64 = 1.0;
/// Period of a look to both sides. [s]
const SEARCH_S: f64 = 6.0;
const GOAL_PER_S: f64 = 1.0;
/// Distance from which an unseen opening is observed: the image is 1.8 m high there. [m]
const VIEW_M: f64 = 1.2;
const VIEW_HEIGHT_M: f64 = 1.4;
const VIEW_MPS: f64 = 0.5;
/// Delay from a decision to the requested speed. [s]
const START_LAG_S: f64 = 0.35;
/// The hand must be away for this time before and after the predicted passage: it covers the vehicle's length of 0.5 m
/// and the error in time. [s]
const EARLY_S: f64 = 0.35;
const LATE_S: f64 = 0.75;
/// Radius of the vehicle plus the error of its path. [m]
const HAND_ROOM_M: f64 = 0.2;

#[cfg(test)]
mod tests;
