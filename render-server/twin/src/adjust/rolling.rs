//! Rolling shutter: rows are exposed one after the other, from different camera poses.
//!
//! An image's pose is that of its middle row. The poses of other rows follow from the camera's velocity: the mean of
//! the velocities to the previous and to the next image. Steps and tremor of a hand are faster than that, so each image
//! has an additional rotation (bend), with a prior from hand motion (Albl et al. 2016, "Degeneracies in rolling shutter
//! SfM": with free rotations, rooms would collapse to a plane).

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use super::capture::Capture;
use super::robust::median;

/// Readout time, and the cameras' motion during it.
#[derive(Clone, Debug)]
pub(super) struct Rolling {
    /// Time from the first row's exposure to the last one's; negative for a phone held upside down. [s]
    pub(super) readout_s: f64,
    /// Rotation of each camera from the first row to the last, in addition to that from its velocity. [rad, cam]
    pub(super) bends_rad: Vec<DVec3>,
    /// Velocity of each camera.
    motions: Vec<CameraVelocity>,
    height_px: f64,
}

/// Velocity of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct CameraVelocity {
    /// [1/s of the state's lengths, world]
    v_world: DVec3,
    /// [rad/s, cam]
    omega_cam: DVec3,
}

/// Motion of a camera at the exposure of a row.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Row {
    /// Position of the row relative to the middle, in image heights: -0.5 to 0.5.
    pub(super) share: f64,
    shift_world: DVec3,
    turn_rad: DVec3,
    motion: CameraVelocity,
}

/// A point in the camera frame at the exposure of a row.
pub(super) struct InRow {
    pub(super) p_cam: DVec3,
    /// Position before the camera's rotation since the middle row.
    p_middle: DVec3,
    row: Row,
}

impl Rolling {
    /// Returns a shutter with a readout time of 0.
    pub(super) fn new(lens: &Intrinsics, images: usize) -> Self {
        Self {
            readout_s: 0.0,
            bends_rad: vec![DVec3::ZERO; images],
            motions: vec![CameraVelocity::default(); images],
            height_px: f64::from(lens.height_px),
        }
    }

    /// Updates the velocities from the present poses.
    pub(super) fn follow(&mut self, capture: &Capture, cameras: &[Pose<World, Cam>]) {
        self.motions = motions(capture, cameras);
    }

    /// Returns the camera's motion at the exposure of a pixel.
    pub(super) fn row(&self, camera: usize, pixel: DVec2) -> Row {
        let share = (pixel.y / self.height_px - 0.5).clamp(-0.5, 0.5);
        let motion = self.motions[camera];
        let at_s = self.readout_s * share;
        Row {
            share,
            shift_world: motion.v_world * at_s,
            turn_rad: motion.omega_cam * at_s + self.bends_rad[camera] * share,
            motion,
        }
    }

    /// Returns the prior standard deviation of the bends, from hand motion. [rad]
    pub(super) fn bend_sigma_rad(&self) -> f64 {
        (self.readout_s.abs() * HAND_RADPS).max(LEAST_BEND_RAD)
    }
}

impl Row {
    /// Returns the camera's pose at the exposure of the row.
    pub(super) fn pose(&self, middle: &Pose<World, Cam>) -> Pose<World, Cam> {
        let turned = middle.rotation * DQuat::from_scaled_axis(self.turn_rad);
        Pose::new(middle.translation_m + self.shift_world, turned)
    }

    /// Transforms a point of the world into the camera frame.
    pub(super) fn see(self, middle: &Pose<World, Cam>, p_world: DVec3) -> InRow {
        let p_middle =
            middle.rotation.conjugate() * (p_world - middle.translation_m - self.shift_world);
        let p_cam = if self.turn_rad == DVec3::ZERO {
            p_middle
        } else {
            DQuat::from_scaled_axis(-self.turn_rad) * p_middle
        };
        InRow { p_cam, p_middle, row: self }
    }
}

/// Derivatives of a pixel by the camera's position, its rotation about its own axes and its bend; by the point; by the
/// readout time.
pub(super) struct Slopes {
    pub(super) by_camera: [DVec2; 9],
    pub(super) by_point: [DVec2; 3],
    pub(super) by_readout: DVec2,
}

impl InRow {
    /// Returns the derivatives, given those by the point in the camera frame.
    pub(super) fn slopes(&self, middle: &Pose<World, Cam>, by_cam: &[DVec2; 3]) -> Slopes {
        let through = |v: DVec3| by_cam[0] * v.x + by_cam[1] * v.y + by_cam[2] * v.z;
        let Row { share, turn_rad, motion, .. } = self.row;
        let on = DMat3::from_quat(DQuat::from_scaled_axis(-turn_rad));
        let cam_from_world = on * DMat3::from_quat(middle.rotation.conjugate());
        let [x, y, z] = DVec3::AXES.map(|axis| through(cam_from_world * axis));
        // A camera rotated by a small w sees the point rotated by -w: p + p x w.
        let turn = DVec3::AXES.map(|axis| through(on * self.p_middle.cross(axis)));
        // Rotation by phi + d as a rotation by phi and a small one: the right Jacobian (Solà et al. 2018, eq. 143).
        let jacobian = |d: DVec3| {
            let once = turn_rad.cross(d);
            d - once / 2.0 + turn_rad.cross(once) / 6.0
        };
        let by_turn_on = |d: DVec3| through(self.p_cam.cross(jacobian(d)));
        let bend = DVec3::AXES.map(|axis| by_turn_on(axis * share));
        let by_readout = by_turn_on(motion.omega_cam * share)
            - through(cam_from_world * (motion.v_world * share));
        let by_camera = [-x, -y, -z, turn[0], turn[1], turn[2], bend[0], bend[1], bend[2]];
        Slopes { by_camera, by_point: [x, y, z], by_readout }
    }
}

/// Returns the cameras' velocities: the mean of those from the previous and to the next image, if close in time. The
/// velocity is zero for isolated images and for leaps.
fn motions(capture: &Capture, cameras: &[Pose<World, Cam>]) -> Vec<CameraVelocity> {
    let between = |a: usize| -> Option<CameraVelocity> {
        let (before, after) = (cameras[a], *cameras.get(a + 1)?);
        let took_s = capture.images[a + 1].at_s - capture.images[a].at_s;
        if !(took_s > 0.0 && took_s <= GAP_S) {
            return None;
        }
        let turn = before.rotation.conjugate() * after.rotation;
        let turn_rad = (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis();
        Some(CameraVelocity {
            v_world: (after.translation_m - before.translation_m) / took_s,
            omega_cam: turn_rad / took_s,
        })
    };
    let steps: Vec<Option<CameraVelocity>> = (0..cameras.len()).map(between).collect();
    let usual = median(steps.iter().flatten().map(|motion| motion.v_world.length())).unwrap_or(0.0);
    let is_walk = |motion: &CameraVelocity| {
        motion.v_world.length() <= LEAP * usual && motion.omega_cam.length() <= MOST_RADPS
    };
    let walked = |step: usize| steps.get(step).copied().flatten().filter(is_walk);
    (0..cameras.len())
        .map(|camera| match (camera.checked_sub(1).and_then(walked), walked(camera)) {
            (Some(a), Some(b)) => CameraVelocity {
                v_world: 0.5 * (a.v_world + b.v_world),
                omega_cam: 0.5 * (a.omega_cam + b.omega_cam),
            },
            (Some(one), None) | (None, Some(one)) => one,
            (None, None) => CameraVelocity::default(),
        })
        .collect()
}

/// Prior standard deviation of the readout time: phones take 10 to 33 ms. [s]
pub(super) const READOUT_S: f64 = 0.03;
/// Maximum readout time: less than the interval of images, and phones film at least 24 per second. [s]
pub(super) const MOST_READOUT_S: f64 = 0.042;
/// Standard deviation of the rotation rate of a walking hand that images a third of a second apart do not show, about
/// each axis. Generated walks have 0.03 to 0.07 RMS; people are less steady. [rad/s]
const HAND_RADPS: f64 = 0.15;
/// Minimum standard deviation of a bend. [rad]
const LEAST_BEND_RAD: f64 = 1e-6;
/// Maximum interval of images that determine a velocity. [s]
const GAP_S: f64 = 1.5;
/// Maximum ratio to the median speed: a faster move is a wrong pose.
const LEAP: f64 = 5.0;
/// Maximum rotation rate of a hand that films. [rad/s]
const MOST_RADPS: f64 = 3.0;
