//! Flies a race course from images: windows, a gap, a window with a rotating hand.
//!
//! It knows no map and no place of anything, nor where it is itself: only what its camera shows,
//! and how it is tilted. What happens at every image, in this order:
//! 1. [`sampling`]: pixels become vectors and colour classes (bars of known windows), [`color_class`];
//! 2. [`odometry`]: where the camera is, by registering its depth to an earlier image;
//! 3. [`plane_detection`]: new windows by their colour, walls by their size;
//! 4. [`planar_obstacle`]: what of each is solid and what is free, and where its opening is widest;
//!    [`known`] keeps them, and selects the next one;
//! 5. [`hand`]: what moves in that opening, and when it will be away;
//! 6. [`steer`]: through the opening of the nearest, clear of everything solid.
//!
//! All is kept in the frame [`sampling::Home`], so a window that has left the image is still there.

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
    /// Where the flight is to end, if the course has a goal. [m, world]
    goal_m: Option<DVec3>,
    grid: PixelGrid,
    odometry: Odometry,
    /// Turn from world axes to home axes about z, set by the first image. [rad]
    home_yaw_rad: Option<f64>,
    known: Known,
    hand: Hand,
    /// What it flies through now.
    target: Option<ObstacleKind>,
    /// Since when the passage is under way: nothing else counts any more. [s]
    committed_s: Option<f64>,
    /// Since when nothing has been found to fly through. [s]
    searching_s: Option<f64>,
    /// Asked for last. [m/s, home]
    setpoint_mps: DVec3,
    /// Whether depth has ever come with an image, and how many images came without before.
    has_depth: bool,
    without_depth: u32,
    /// Number of the image seen last.
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
        // Another camera's image has come: this one has been answered.
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

/// Where the vehicle is by its own reckoning.
#[derive(Clone, Copy, Debug)]
pub struct Here {
    /// Of the body. [m, home]
    pub p_m: DVec3,
    /// Of the camera. [m, home]
    pub camera_m: DVec3,
    /// The course's goal, where the course gives it and the vehicle's position. [m, home]
    pub goal_m: Option<DVec3>,
}

impl Race {
    /// Returns where it thinks its camera is. [m, home]
    pub fn here_m(&self) -> DVec3 {
        self.odometry.p_m
    }

    /// Returns what it has found.
    pub fn known(&self) -> &Known {
        &self.known
    }

    /// Returns what it flies through now.
    pub fn target(&self) -> Option<ObstacleKind> {
        self.target
    }

    /// Returns how the hand turns, once that is known.
    pub fn hand(&self) -> Option<&hand::HandRotation> {
        self.hand.motion()
    }

    /// Whether images come with depth; until one has, nothing is answered and the vehicle stays on the
    /// ground.
    ///
    /// # Panics
    /// If none has for a second: it cannot fly here, and the runtime reports this sentence.
    fn has_depth(&mut self, camera: &CameraImage<'_>) -> bool {
        self.has_depth |= camera.depth_mm.iter().any(|&depth_mm| depth_mm > 0);
        self.without_depth += u32::from(!self.has_depth);
        assert!(
            self.has_depth || self.without_depth < PATIENCE,
            "race needs depth, and this course's level gives colour alone (g); fly it with --level ug"
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
        // Before take-off nobody follows: the setpoint must not run away from the vehicle.
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

    /// Takes an image in: what it shows, and from where.
    fn look(&mut self, now_s: f64, vehicle: &Vehicle, camera: &CameraImage<'_>) -> Here {
        // The attitude is newer or older than the image by some milliseconds of steady turning.
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

    /// Returns a velocity [m/s, home] and where to look [rad, home].
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
            // Go where its middle can be seen from.
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

    /// Returns where the obstacle after this one is seen. [rad, home]
    fn beyond_rad(&self, here: &Here, obstacle: &PlanarObstacle) -> Option<f64> {
        let next = self.known.next(here.p_m, Some(obstacle.kind))?;
        let middle_m = next.opening.map_or(next.plane.origin_m, |opening| opening.center_m);
        let look_rad = (middle_m - here.p_m).truncate().to_angle();
        Some(look_rad.clamp(-MAX_LOOK_RAD, MAX_LOOK_RAD))
    }

    /// Looks about for something to fly through.
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

/// So many images without any depth, and there is none: a second of them. A camera that is covered
/// shows none for a while.
const PATIENCE: u32 = 30;
/// Images farther apart than this are a gap, not a step. [s]
const MAX_DT_S: f64 = 0.1;
/// Ahead and sideways together. [m/s]
const MAX_MPS: f64 = 1.3;
/// Tilts the camera by atan(3.5 / 9.81) = 20 degrees. [m/s^2]
const SLEW_MPS2: f64 = 3.5;
/// The setpoint leads the velocity by slew times lag, 0.9 m/s; a little more is allowed. [m/s]
const MAX_LEAD_MPS: f64 = 1.2;
/// From here on, this near to the line, the passage has begun. [m]
const COMMIT_M: f64 = 0.35;
const COMMIT_OFF_M: f64 = 0.15;
/// A passage that takes longer has failed, and is begun again: a metre takes 1.4 s. [s]
const THROUGH_S: f64 = 4.0;
/// What is free must be as wide as the vehicle with half of it again on each side. [m]
const WIDE_ENOUGH_M: f64 = 0.27;
/// Nearer than this, the opening fills the image: look for the next. [m]
const LOOK_M: f64 = 0.45;
const MAX_LOOK_RAD: f64 = 1.0;
/// A look to both sides and back. [s]
const SEARCH_S: f64 = 6.0;
const GOAL_PER_S: f64 = 1.0;
/// Where an opening that is not seen yet is looked for from: the image is 1.8 m high there. [m]
const VIEW_M: f64 = 1.2;
const VIEW_HEIGHT_M: f64 = 1.4;
const VIEW_MPS: f64 = 0.5;
/// From a decision to the speed asked for. [s]
const START_LAG_S: f64 = 0.35;
/// Before and after the reckoned moment the hand must be away too: the vehicle is half a metre
/// long with what it may be early and late by. [s]
const EARLY_S: f64 = 0.35;
const LATE_S: f64 = 0.75;
/// The vehicle's radius and the error of its way. [m]
const HAND_ROOM_M: f64 = 0.2;

#[cfg(test)]
mod tests;
