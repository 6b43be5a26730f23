//! World frame of a capture without surveyed tags. The floor defines the vertical axis. The scale comes from a measured
//! length or the size of the tags, otherwise it is guessed. Alternatively, a motion capture track defines all of it.

use glam::{DQuat, DVec3};
use vizflyt_twin::adjust::{Adjusted, Capture};
use vizflyt_twin::align::corners::{Ray, meet};
use vizflyt_twin::align::level::{self, Held};
use vizflyt_twin::align::{Fit, Similarity};

use super::{Length, Room};
use crate::scene::capture::prints::Seen;

/// World frame of an adjusted capture.
#[derive(Clone, Debug)]
pub(super) struct Ground {
    /// Transform from the adjustment's frame to the world.
    pub(super) place: Similarity,
    pub(super) scale_from: String,
    pub(super) scale_is_guessed: bool,
    pub(super) up_from: String,
    /// Uncertainty of the quantities that the adjustment does not determine.
    pub(super) fit: Option<Fit>,
}

impl Ground {
    /// Returns the world frame of a motion capture track.
    pub(super) fn of_track(fit: Fit) -> Self {
        let track = "the motion capture's track".to_owned();
        Self {
            place: fit.world_from_scene,
            scale_from: track.clone(),
            scale_is_guessed: false,
            up_from: track,
            fit: Some(fit),
        }
    }

    /// Determines the quantities that the adjustment leaves open.
    pub(super) fn of(capture: &Capture, adjusted: &Adjusted, seen: &Seen, room: &Room) -> Self {
        if adjusted.known.place {
            let measured = "the surveyed positions of the tags".to_owned();
            return Self {
                place: IDENTITY,
                scale_from: measured.clone(),
                scale_is_guessed: false,
                up_from: measured,
                fit: None,
            };
        }
        let cameras: Vec<Held> = adjusted
            .world_from_cam
            .iter()
            .map(|pose| Held { position: pose.translation_m, up: pose.rotation * -DVec3::Y })
            .collect();
        let level = level::find(&adjusted.points_m, &cameras);
        let hand = cameras.iter().map(|held| held.up).sum::<DVec3>().normalize_or(DVec3::Z);
        let (up, up_from) = match level {
            Some(level) => (level.up, format!("the floor, by {} points", level.points)),
            None => (hand, "the attitude of the camera, because no floor was found".to_owned()),
        };
        let mut heights: Vec<f64> = cameras.iter().map(|held| up.dot(held.position)).collect();
        heights.sort_by(f64::total_cmp);
        let hand_height = heights.get(heights.len() / 2).copied().unwrap_or(0.0);
        let tape = room.length.and_then(|length| tape(capture, adjusted, seen, length));
        let (scale, scale_sigma, scale_from) = match (tape, adjusted.known.scale, level) {
            (Some((scale, sigma)), ..) => {
                let metres = room.length.map_or(0.0, |length| length.metres);
                (scale, sigma, format!("a length of {metres} m between two tags"))
            }
            (None, true, _) => {
                let sigma = adjusted.scale_sigma.unwrap_or(GUESS_SHARE);
                (1.0, sigma, "the size of the tags".to_owned())
            }
            (None, false, Some(level)) => {
                let height = hand_height - level.height;
                let from = format!(
                    "the assumption that the camera was carried {HAND_M} m above the floor"
                );
                (HAND_M / height.max(1e-9), GUESS_SHARE, from)
            }
            (None, false, None) => {
                (1.0, GUESS_SHARE, "the assumption that a unit of the model is a metre".to_owned())
            }
        };
        let upright = DQuat::from_rotation_arc(up, DVec3::Z);
        // The first picture is above the origin and looks along x.
        let ahead = adjusted
            .world_from_cam
            .first()
            .map_or(DVec3::X, |pose| upright * (pose.rotation * DVec3::Z));
        let rotation = DQuat::from_rotation_z(-ahead.y.atan2(ahead.x)) * upright;
        let start = cameras.first().map_or(DVec3::ZERO, |held| rotation * held.position);
        let floor = level.map_or(hand_height - HAND_M / scale, |level| level.height);
        let translation_m = -DVec3::new(start.x, start.y, floor) * scale;
        let fit = level.map(|level| Fit {
            world_from_scene: Similarity { scale, rotation, translation_m },
            rms_m: level.rms * scale,
            worst_m: level.rms * scale,
            used: level.points,
            left_out: 0,
            scale_sigma,
            tilt_sigma_rad: level.tilt_sigma_rad.hypot(FLOOR_TILT_RAD),
            yaw_sigma_rad: 0.0,
            place_sigma_m: 0.0,
            middle_m: DVec3::ZERO,
        });
        Self {
            place: Similarity { scale, rotation, translation_m },
            scale_is_guessed: tape.is_none() && !adjusted.known.scale,
            scale_from,
            up_from,
            fit,
        }
    }
}

/// Returns the scale of the adjustment and its relative sigma, from the measured distance between the centres of two
/// tags. `None` if one of them is not seen from two positions.
fn tape(capture: &Capture, adjusted: &Adjusted, seen: &Seen, length: Length) -> Option<(f64, f64)> {
    let middle = |id: u32| {
        let mut rays: [Vec<Ray>; 4] = Default::default();
        for (image, pose) in capture.images.iter().zip(&adjusted.world_from_cam) {
            for sighting in seen.of(&image.name).iter().filter(|s| seen.tags[s.tag].id == id) {
                for (rays, pixel) in rays.iter_mut().zip(sighting.corners()) {
                    let Some(slope) = adjusted.lens.slope(pixel) else { continue };
                    let direction = (pose.rotation * slope.extend(1.0)).normalize();
                    rays.push(Ray { origin: pose.translation_m, direction });
                }
            }
        }
        let corners: Option<Vec<DVec3>> =
            rays.iter().map(|rays| Some(meet(rays)?.position)).collect();
        corners.map(|corners| corners.into_iter().sum::<DVec3>() / 4.0)
    };
    let [a, b] = [middle(length.ids[0])?, middle(length.ids[1])?];
    let scale = length.metres / a.distance(b).max(1e-12);
    Some((scale, TAPE_SIGMA_M / length.metres))
}

const IDENTITY: Similarity =
    Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };
/// Assumed height of a phone that is held in front of the chest. [m]
const HAND_M: f64 = 1.45;
/// Relative sigma of a guessed scale: heights of 1.2 to 1.7 m are within two sigmas.
const GUESS_SHARE: f64 = 0.1;
/// Standard deviation of the measured distance between two sheets of paper, including the centres in pictures. [m]
const TAPE_SIGMA_M: f64 = 0.004;
/// Floors are level to about 3 mm over 2 m (DIN 18202, table 3). [rad]
const FLOOR_TILT_RAD: f64 = 0.0015;
