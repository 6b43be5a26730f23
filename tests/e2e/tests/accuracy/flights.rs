//! Flights with known truth through the simulated lab, and the accuracy of their localization.

use glam::{DQuat, DVec2, DVec3, EulerRot};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::HostTime;
use vizflyt_tags::camera::TagCamera;
use vizflyt_tags::layout::TagLayout;
use vizflyt_tags::locate::{LocateSettings, LocateSetup, Locator, StampedImage};
use vizflyt_tags::print::Pad;
use vizflyt_tags::simulated::{Sensor, SimulatedCamera, Truth};

/// Position on a path by distance flown. [m -> m, world]
pub(crate) type Path = fn(f64) -> DVec3;

/// A square of 2 m about the hall's centre, with rounded corners like a real flight.
pub(crate) fn square(s_m: f64) -> DVec3 {
    let at = (s_m / 2.0).rem_euclid(4.0);
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    // The mean over a quarter of a side rounds the corners.
    let place = |at: f64| {
        let (i, t) = (at.floor() as usize % 4, at.fract());
        let ((ax, ay), (bx, by)) = (corners[i], corners[(i + 1) % 4]);
        DVec3::new(5.5 + ax + (bx - ax) * t, ay + (by - ay) * t, 1.2)
    };
    (0..16).map(|i| place((at + (f64::from(i) - 7.5) / 64.0).rem_euclid(4.0))).sum::<DVec3>() / 16.0
}

/// A spiral: radius 0.5 to 1.4 m, height 0.6 to 1.9 m, and back.
pub(crate) fn spiral(s_m: f64) -> DVec3 {
    let t = (1.0 - (s_m / 12.0 * std::f64::consts::PI).cos()) / 2.0;
    let angle = s_m / 0.95;
    let radius = 0.5 + 0.9 * t;
    DVec3::new(5.5 + radius * angle.cos(), radius * angle.sin(), 0.6 + 1.3 * t)
}

/// A lemniscate, 5 m along the hall and 1.8 m across.
pub(crate) fn lemniscate(s_m: f64) -> DVec3 {
    let angle = s_m / 2.0;
    DVec3::new(5.5 + 2.5 * angle.sin(), 1.8 * angle.sin() * angle.cos(), 1.2 + 0.2 * angle.cos())
}

/// Returns the pose of a vehicle on a path: it leans into its accelerations and turns slowly.
pub(crate) fn pose_on(path: impl Fn(f64) -> DVec3, speed_mps: f64, t_s: f64) -> Pose<World, Body> {
    let at = |t: f64| path(speed_mps * t);
    let h = 0.08;
    let acceleration = (at(t_s + h) + at(t_s - h) - 2.0 * at(t_s)) / (h * h);
    let thrust = (acceleration.clamp_length_max(6.0) + DVec3::Z * 9.81).normalize();
    let yaw = DQuat::from_euler(EulerRot::ZYX, 0.3 + 0.4 * (0.5 * t_s).sin() + 0.2 * t_s, 0.0, 0.0);
    Pose::new(at(t_s), DQuat::from_rotation_arc(DVec3::Z, thrust) * yaw)
}

/// Returns the take-off and landing pads of the simulated room.
pub(crate) fn pads() -> Vec<Pad> {
    let landing_m = DVec2::new(1.2, 0.35);
    vec![
        Pad { middle_m: DVec2::new(0.9, 0.0), size_m: Pad::SIZE_M },
        Pad { middle_m: DVec2::new(10.0, 0.0), size_m: landing_m },
    ]
}

/// Accuracy of a flight's localization.
#[derive(Clone, Debug, Default)]
pub(crate) struct Figures {
    /// Number of sets of images.
    pub(crate) sets: usize,
    /// Position errors. [m]
    pub(crate) errors_m: Vec<f64>,
    /// Attitude errors. [rad]
    pub(crate) errors_rad: Vec<f64>,
    /// Sum of squared errors in units of the predicted standard deviations, of six components.
    pub(crate) squared_sigmas: f64,
    /// Sum of squared errors in units of the predicted standard deviations, of the position's three components.
    pub(crate) squared_sigmas_m: f64,
    /// Reasons of sets without a pose.
    pub(crate) unlocated: Vec<String>,
    /// Sum of the searched fractions of the images.
    pub(crate) looked_at: f64,
}

impl Figures {
    /// Returns the RMS position error. [mm]
    pub(crate) fn rms_mm(&self) -> f64 {
        rms(&self.errors_m) * 1e3
    }

    /// Returns the 99th percentile of the position error. [mm]
    pub(crate) fn p99_mm(&self) -> f64 {
        let mut sorted = self.errors_m.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get((sorted.len() as f64 * 0.99) as usize).map_or(f64::NAN, |m| m * 1e3)
    }

    /// Returns the RMS attitude error. [deg]
    pub(crate) fn rms_deg(&self) -> f64 {
        rms(&self.errors_rad).to_degrees()
    }

    /// Returns the fraction of sets in which the vehicle was located. [%]
    pub(crate) fn availability_percent(&self) -> f64 {
        100.0 * self.errors_m.len() as f64 / self.sets as f64
    }

    /// Returns the mean squared error in units of sigma; 1 means correct sigmas.
    pub(crate) fn consistency(&self) -> f64 {
        self.squared_sigmas / (6 * self.errors_m.len()) as f64
    }

    /// Returns the mean squared error of only the position, in units of sigma.
    #[allow(dead_code, reason = "the bench prints that of the whole pose")]
    pub(crate) fn position_consistency(&self) -> f64 {
        self.squared_sigmas_m / (3 * self.errors_m.len()) as f64
    }
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// Flies and locates. Exposures of the cameras are spread over the interval, as for unsynchronised webcams, unless
/// `together` is set.
pub(crate) fn fly(
    cameras: Vec<TagCamera>,
    layouts: &[TagLayout],
    sensor: Sensor,
    together: bool,
    seconds: f64,
    pose_at: impl Fn(f64) -> Pose<World, Body>,
) -> Figures {
    let count = cameras.len();
    let simulated = cameras.into_iter().enumerate().map(|(i, camera)| {
        let phase = if together { 0.0 } else { i as f64 / count as f64 };
        SimulatedCamera::new(camera, Sensor { phase, ..sensor })
    });
    locate(simulated.collect(), layouts, seconds, pose_at)
}

/// Flies with a webcam under the vehicle over the hall's mat with pads. Errors of survey and mount follow from the
/// seed; `before` creates the camera that draws the images.
pub(crate) fn fly_over_mat(
    pads: Vec<Pad>,
    seed: u64,
    before: impl Fn(TagCamera, Sensor) -> SimulatedCamera,
    seconds: f64,
    pose_at: impl Fn(f64) -> Pose<World, Body>,
) -> Figures {
    let lab =
        LocateSetup::simulated_over_mat(pads, seed, "vizflyt").expect("there are tags enough");
    let locator = Locator::new(lab.cameras, &lab.layouts, lab.settings).expect("the lab is sound");
    let truth = lab.truth.expect("it is simulated");
    let sensor = lab.simulated.sensor(0, 1);
    let cameras = truth.cameras.into_iter().map(|camera| before(camera, sensor)).collect();
    run(locator, cameras, &truth.layouts, seconds, pose_at)
}

/// Flies in front of cameras and locates.
pub(crate) fn locate(
    simulated: Vec<SimulatedCamera>,
    layouts: &[TagLayout],
    seconds: f64,
    pose_at: impl Fn(f64) -> Pose<World, Body>,
) -> Figures {
    let cameras = simulated.iter().map(|camera| camera.camera().clone()).collect();
    let locator =
        Locator::new(cameras, layouts, LocateSettings::default()).expect("the lab is sound");
    run(locator, simulated, layouts, seconds, pose_at)
}

fn run(
    mut locator: Locator,
    mut simulated: Vec<SimulatedCamera>,
    layouts: &[TagLayout],
    seconds: f64,
    pose_at: impl Fn(f64) -> Pose<World, Body>,
) -> Figures {
    let mut figures = Figures::default();
    let mut truth = Truth::default();
    let start = HostTime::from_ns(5_000_000_000);
    for tick in 0..(seconds * 400.0) as u32 {
        let t_s = f64::from(tick) / 400.0;
        truth.push(start.plus_seconds(t_s), pose_at(t_s));
        let images: Vec<_> = simulated
            .iter_mut()
            .enumerate()
            .filter_map(|(i, camera)| Some((i, camera.expose(&truth, layouts, false)?)))
            .collect();
        if images.is_empty() {
            continue;
        }
        let views: Vec<StampedImage> = images
            .iter()
            .map(|(camera, (stamp, image))| StampedImage { camera: *camera, stamp: *stamp, image })
            .collect();
        let outcome = locator.handle_images(&views);
        figures.sets += 1;
        for look in &outcome.looks {
            figures.looked_at += look.region.map_or(1.0, |region| {
                let size = (region.most_px - region.least_px) / glam::DVec2::new(1280.0, 720.0);
                (size.x * size.y).min(1.0)
            });
        }
        match outcome.located {
            Ok(located) => {
                let true_pose = pose_at(located.stamp.seconds_since(start));
                let off = located.world_from_body.translation_m - true_pose.translation_m;
                let turn = true_pose.rotation.conjugate() * located.world_from_body.rotation;
                let turn = (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis();
                figures.errors_m.push(off.length());
                figures.errors_rad.push(turn.length());
                let square_m = (off / located.position_sigma_m).length_squared();
                figures.squared_sigmas_m += square_m;
                figures.squared_sigmas +=
                    square_m + (turn / located.rotation_sigma_rad).length_squared();
            }
            Err(why) => figures.unlocated.push(format!("{t_s:.2} s: {why:?}")),
        }
    }
    figures
}
