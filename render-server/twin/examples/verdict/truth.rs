//! True poses of the camera, and the error of a model.

use std::path::Path;

use glam::{DQuat, DVec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Cam, Pose, World};
use vizflyt_twin::align::points::{self, Pair};

/// True poses of a capture's images.
pub(crate) struct Truth {
    /// Images in the order of time.
    pub(crate) images: Vec<TrueImage>,
}

pub(crate) struct TrueImage {
    pub(crate) name: String,
    pub(crate) at_s: f64,
    pose: Pose<World, Cam>,
}

impl TrueImage {
    /// Returns the true position, rounded to a millimetre. [m, world]
    pub(crate) fn position_m(&self) -> [f64; 3] {
        self.pose.translation_m.to_array().map(|x| (x * 1e3).round() / 1e3)
    }
}

#[derive(Deserialize)]
struct File {
    images: Vec<Row>,
}

#[derive(Deserialize)]
struct Row {
    file: String,
    stamp_ns: u64,
    world_from_cam: RowPose,
}

#[derive(Deserialize)]
struct RowPose {
    position_m: [f64; 3],
    rotation_xyzw: [f64; 4],
}

impl Truth {
    pub(crate) fn read(path: &Path) -> Result<Self, Box<dyn std::error::Error>> {
        let file: File = serde_json::from_str(&std::fs::read_to_string(path)?)?;
        let images = file.images.into_iter().map(|row| TrueImage {
            name: row.file,
            at_s: row.stamp_ns as f64 * 1e-9,
            pose: Pose::new(
                DVec3::from_array(row.world_from_cam.position_m),
                DQuat::from_array(row.world_from_cam.rotation_xyzw),
            ),
        });
        Ok(Self { images: images.collect() })
    }

    /// Formats the errors of the camera's positions; `is_fitted` removes the best-fitting similarity transform first.
    pub(crate) fn compare(&self, poses: &[(&str, Pose<World, Cam>)], is_fitted: bool) -> String {
        let pairs: Vec<(Pose<World, Cam>, Pose<World, Cam>)> = poses
            .iter()
            .filter_map(|(name, pose)| {
                let image = self.images.iter().find(|image| image.name == *name)?;
                Some((*pose, image.pose))
            })
            .collect();
        let places: Vec<Pair> = pairs
            .iter()
            .map(|(found, truth)| Pair { scene: found.translation_m, world_m: truth.translation_m })
            .collect();
        // A large sigma: all images count, as in the usual error measure of trajectories.
        let Ok(fit) = points::fit(&places, 1e3) else { return "no similarity fits".to_owned() };
        let to = fit.world_from_scene;
        let mut off_m: Vec<f64> = pairs
            .iter()
            .map(|(found, truth)| {
                let at = if is_fitted {
                    to.transform_point(found.translation_m)
                } else {
                    found.translation_m
                };
                at.distance(truth.translation_m)
            })
            .collect();
        let rms_m = (off_m.iter().map(|m| m * m).sum::<f64>() / off_m.len() as f64).sqrt();
        off_m.sort_by(f64::total_cmp);
        let worst_m = off_m.last().copied().unwrap_or(f64::NAN);
        let tilt = (to.rotation * DVec3::Z).angle_between(DVec3::Z).to_degrees();
        let scale = 100.0 * (1.0 / to.scale - 1.0);
        if is_fitted {
            return format!("ATE {:.2} cm, worst {:.2} cm", 100.0 * rms_m, 100.0 * worst_m);
        }
        format!(
            "centres {:.2} cm, worst {:.2} cm; scale {scale:+.3} %, up {tilt:.3} degrees",
            100.0 * rms_m,
            100.0 * worst_m
        )
    }
}
