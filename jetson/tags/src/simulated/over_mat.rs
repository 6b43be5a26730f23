//! The simulated lab in which the vehicle carries the camera: what lies on the floor, what looks at it, and by how much
//! both are other than their files say.
//!
//! Nobody knows a mat to the last tenth of a millimetre. A survey leaves each tag off by itself, and all of them bent
//! together: it walks from one end of the hall to the other. A camera is screwed on, and its place is measured with a
//! ruler. Locating by files that are exact would show accuracies, and sigmas, that no lab has.

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};

use super::Sensor;
use crate::camera::{Mounting, TagCamera};
use crate::family::TagFamily;
use crate::layout::{Tag, TagLayout};
use crate::print::{BAR_MM, Floor, Pad};
use crate::synth::Random;

/// Returns the mat of the simulated hall of 11 x 4.5 m (x from 0 to 11, y from -2.25 to 2.25), as
/// `vizflyt tags print mat --fly-over 11x4.5 --middle-m 5.5,0,0` prints it, with pads where the vehicle stands.
pub fn floor(pads: Vec<Pad>) -> Floor {
    Floor {
        family: TagFamily::Tag36h11,
        first_id: 100,
        size_m: DVec2::new(11.0, 4.5),
        middle_m: DVec3::X * 5.5,
        pads,
        bar_mm: BAR_MM,
    }
}

/// Returns the webcam under the vehicle: 640 x 480, 100 degrees across. It looks straight down, the image's top
/// towards the nose, its lens 80 mm above the soles of the vehicle's legs.
pub fn camera() -> TagCamera {
    let k = Intrinsics::from_horizontal_fov(640, 480, 100f64.to_radians());
    let distortion =
        Distortion::BrownConrady { k1: -0.12, k2: 0.03, p1: 0.0008, p2: -0.0005, k3: 0.0 };
    let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_X, DVec3::NEG_Z);
    let place_m = DVec3::new(0.02, 0.0, LENS_M);
    TagCamera {
        name: "belly".into(),
        source: None,
        intrinsics: Intrinsics { distortion, cx_px: k.cx_px + 3.0, cy_px: k.cy_px - 2.0, ..k },
        mounting: Mounting::Body(Pose::new(place_m, DQuat::from_mat3(&axes))),
        calibration: None,
        survey: None,
        latency_ms: 0.0,
    }
}

/// Returns how it takes images: a lens of 2.1 mm and f/2.4 that is focused once, at 0.6 m, and sharp from there on.
pub fn sensor() -> Sensor {
    Sensor { focus_m: 0.6, aperture_m: 0.0021 / 2.4, ..Sensor::default() }
}

/// Returns the mat as it truly lies, for a file that a survey has written.
pub fn as_laid(file: &TagLayout, seed: u64) -> TagLayout {
    let mut random = Random::new(seed ^ 0x6d61_745f);
    let phases = DVec3::from_array(std::array::from_fn(|_| std::f64::consts::TAU * random.unit()));
    let tags = file.tags.iter().map(|tag| {
        let angles = DVec3::splat(tag.position_m.x * std::f64::consts::TAU / BEND_M) + phases;
        let bent_m = BENT_M * 2f64.sqrt() * DVec3::from_array(angles.to_array().map(f64::sin));
        let place_m = bent_m + TAG_SIGMA_M * normal(&mut random);
        // Corners, too, are known as well as that.
        let turn = TURN_SHARE * TAG_SIGMA_M / tag.size_m * normal(&mut random);
        Tag {
            position_m: tag.position_m + place_m,
            rotation_xyzw: (DQuat::from_scaled_axis(turn) * tag.rotation_xyzw).normalize(),
            ..*tag
        }
    });
    TagLayout { tags: tags.collect(), ..*file }
}

/// Returns the camera as it is truly mounted, for a file that a ruler and a level have written.
pub fn as_mounted(file: &TagCamera, seed: u64) -> TagCamera {
    let mut random = Random::new(seed ^ 0x6361_6d5f);
    // There is one mount in a flight: off by as much as is said, in a direction of its own.
    let mut direction = || 3f64.sqrt() * normal(&mut random).normalize();
    let off_m = MOUNT_SIGMA_M * direction();
    let turn = DQuat::from_scaled_axis(MOUNT_SIGMA_RAD * direction());
    let mounting = match file.mounting {
        Mounting::Body(pose) => Mounting::Body(Pose::new(
            pose.translation_m + off_m,
            (pose.rotation * turn).normalize(),
        )),
        other => other,
    };
    TagCamera { mounting, ..file.clone() }
}

fn normal(random: &mut Random) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| random.normal()))
}

/// The lens above the soles. [m]
const LENS_M: f64 = 0.08;
/// What a survey leaves of a tag's own place, one standard deviation an axis. [m]
const TAG_SIGMA_M: f64 = 0.0005;
/// And of its turn, in units of that over its edge.
const TURN_SHARE: f64 = 0.5;
/// How far it bends the whole, root mean square an axis, [m]
const BENT_M: f64 = 0.0015;
/// and over which length to and fro. [m]
const BEND_M: f64 = 5.0;
/// What the lab states of its mat: both together, 1.6 mm, and more, for what is bent is bent over metres. [m]
pub const SURVEY_SIGMA_M: f64 = 0.0025;
/// What a ruler leaves of the camera's place, one standard deviation an axis, [m]
const MOUNT_SIGMA_M: f64 = 0.0015;
/// and the mat's level of its direction. [rad]
const MOUNT_SIGMA_RAD: f64 = 0.0015;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::{Body, World};

    #[test]
    fn wherever_it_stands_on_a_pad_the_camera_sees_a_whole_tag() {
        let pad = Pad { middle_m: DVec2::new(0.9, 0.0), size_m: Pad::SIZE_M };
        let layout = floor(vec![pad]).print().unwrap().layout;
        layout.validate().unwrap();
        let camera = camera();
        let k = camera.intrinsics;
        let Mounting::Body(body_from_cam) = camera.mounting else { panic!("it is carried") };
        let mut random = Random::new(1);
        for _ in 0..500 {
            let at = (DVec2::new(random.unit(), random.unit()) - 0.5) * DVec2::new(0.35, 0.2);
            let turn = DQuat::from_rotation_z(std::f64::consts::TAU * random.unit());
            let lens = DVec3::new(0.02, 0.0, 0.0);
            let place_m = (pad.middle_m + at).extend(0.0) - turn * lens;
            let world_from_body: Pose<World, Body> = Pose::new(place_m, turn);
            let cam_from_world = (world_from_body * body_from_cam).inverse();
            let seen = |tag: &&Tag| {
                tag.corners_m().iter().all(|corner| {
                    let rim = tag.position_m + 1.15 * (*corner - tag.position_m);
                    k.project(cam_from_world.transform_point(rim)).is_some_and(|px| {
                        px.x > 0.0
                            && px.y > 0.0
                            && px.x < f64::from(k.width_px)
                            && px.y < f64::from(k.height_px)
                    })
                })
            };
            assert!(layout.tags.iter().any(|tag| seen(&tag)), "at {at}, {turn}");
        }
    }

    #[test]
    fn errors_are_of_the_size_that_is_said_and_repeat() {
        let layout = floor(Vec::new()).print().unwrap().layout;
        let laid = as_laid(&layout, 3);
        assert_eq!(laid, as_laid(&layout, 3));
        assert_ne!(laid, as_laid(&layout, 4));
        let squares = layout
            .tags
            .iter()
            .zip(&laid.tags)
            .map(|(file, tag)| file.position_m.distance_squared(tag.position_m));
        let rms_m = (squares.sum::<f64>() / (3.0 * layout.tags.len() as f64)).sqrt();
        assert!((rms_m - TAG_SIGMA_M.hypot(BENT_M)).abs() < 0.0003, "{rms_m} m");
    }
}
