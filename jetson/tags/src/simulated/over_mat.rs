//! The simulated lab in which the vehicle carries the camera: floor mat, camera, and their deviations from the files.
//!
//! A real mat is not known to a tenth of a millimetre. A survey has an independent error for each tag, and a common
//! bend that drifts from one end of the hall to the other. The camera's position on the vehicle is measured with a
//! ruler. Exact files would give accuracies and sigmas that no real lab reaches.

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};

use super::Sensor;
use crate::camera::{Mounting, TagCamera};
use crate::family::TagFamily;
use crate::layout::{Tag, TagLayout};
use crate::print::{BAR_MM, Floor, Pad};
use crate::synth::Random;

/// Returns the mat of the simulated hall of 11 x 4.5 m (x from 0 to 11, y from -2.25 to 2.25), as printed by `vizflyt
/// tags print mat --fly-over 11x4.5 --middle-m 5.5,0,0`, with pads where the vehicle stands.
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

/// Returns the webcam under the vehicle: 640 x 480, horizontal field of view 100 degrees. It looks straight down, with
/// the image's top towards the nose. The lens is 80 mm above the soles of the vehicle's legs.
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

/// Returns the sensor of the webcam: a lens of 2.1 mm and f/2.4, focused at 0.6 m and sharp beyond.
pub fn sensor() -> Sensor {
    Sensor { focus_m: 0.6, aperture_m: 0.0021 / 2.4, ..Sensor::default() }
}

/// Returns the true mat for a surveyed file.
pub fn as_laid(file: &TagLayout, seed: u64) -> TagLayout {
    let mut random = Random::new(seed ^ 0x6d61_745f);
    let phases = DVec3::from_array(std::array::from_fn(|_| std::f64::consts::TAU * random.unit()));
    let tags = file.tags.iter().map(|tag| {
        let angles = DVec3::splat(tag.position_m.x * std::f64::consts::TAU / BEND_M) + phases;
        let bent_m = BENT_M * 2f64.sqrt() * DVec3::from_array(angles.to_array().map(f64::sin));
        let place_m = bent_m + TAG_SIGMA_M * normal(&mut random);
        // Corners have the same accuracy.
        let turn = TURN_SHARE * TAG_SIGMA_M / tag.size_m * normal(&mut random);
        Tag {
            position_m: tag.position_m + place_m,
            rotation_xyzw: (DQuat::from_scaled_axis(turn) * tag.rotation_xyzw).normalize(),
            ..*tag
        }
    });
    TagLayout { tags: tags.collect(), ..*file }
}

/// Returns the true camera for a file from ruler and level.
pub fn as_mounted(file: &TagCamera, seed: u64) -> TagCamera {
    let mut random = Random::new(seed ^ 0x6361_6d5f);
    // A flight has a single mount: its error always has the stated size, in a random direction.
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

/// Height of the lens above the soles. [m]
const LENS_M: f64 = 0.08;
/// Position error of a tag after a survey, standard deviation per axis. [m]
const TAG_SIGMA_M: f64 = 0.0005;
/// Rotation error of a tag, in units of the position error divided by the edge.
const TURN_SHARE: f64 = 0.5;
/// Bend of the whole mat, root mean square per axis. [m]
const BENT_M: f64 = 0.0015;
/// Wavelength of the bend. [m]
const BEND_M: f64 = 5.0;
/// Stated uncertainty of the mat: both errors together are 1.6 mm; more, because the bend is constant over metres. [m]
pub const SURVEY_SIGMA_M: f64 = 0.0025;
/// Position error of the camera after measurement by ruler, standard deviation per axis. [m]
const MOUNT_SIGMA_M: f64 = 0.0015;
/// Rotation error of the camera after levelling by the mat. [rad]
const MOUNT_SIGMA_RAD: f64 = 0.0015;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::{Body, World};

    #[test]
    fn camera_sees_a_complete_tag_anywhere_on_a_pad() {
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
    fn errors_have_the_stated_size_and_are_reproducible() {
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
