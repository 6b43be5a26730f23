//! Shows a scene at another place than it was loaded to, by moving the camera instead of the splats.

use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::METRES_PER_UNIT;
use vizflyt_protocol::geometry::Pose;
use vizflyt_splat::Camera;

use crate::scene::WorldFromScene;

/// Placement of a scene's file in the world, by the keys of `[scene]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Place {
    /// Rotation from the file's axes to the world's: a unit quaternion x, y, z, w.
    rotation: [f64; 4],
    /// Length of the file's unit. [m]
    metres_per_unit: f64,
    /// Position of the file's origin. [m, world]
    origin: [f64; 3],
}

impl Place {
    /// Converts a similarity.
    pub fn new(world_from_scene: &WorldFromScene) -> Self {
        let WorldFromScene { scale, rotation, translation_m } = world_from_scene;
        Self {
            rotation: rotation.to_array(),
            metres_per_unit: *scale,
            origin: translation_m.to_array(),
        }
    }

    /// Returns the similarity; `None` if it is invalid.
    pub fn world_from_scene(&self) -> Option<WorldFromScene> {
        let rotation = glam::DQuat::from_array(self.rotation);
        let translation_m = DVec3::from_array(self.origin);
        let is_one = METRES_PER_UNIT.contains(&self.metres_per_unit)
            && (rotation.length() - 1.0).abs() < 1e-3
            && translation_m.abs().cmple(DVec3::splat(FARTHEST_M)).all();
        let rotation = rotation.normalize();
        is_one.then_some(WorldFromScene { scale: self.metres_per_unit, rotation, translation_m })
    }
}

/// Returns the position of a point of a scene's file. [m, world]
pub(super) fn to_world(world_from_scene: &WorldFromScene, p_scene: DVec3) -> DVec3 {
    world_from_scene.rotation * p_scene * world_from_scene.scale + world_from_scene.translation_m
}

/// Returns the similarity from the world of one placement to that of another, for the same scene.
pub(super) fn between(to: &WorldFromScene, from: &WorldFromScene) -> WorldFromScene {
    let scale = to.scale / from.scale;
    let rotation = to.rotation * from.rotation.conjugate();
    let translation_m = to.translation_m - rotation * from.translation_m * scale;
    WorldFromScene { scale, rotation, translation_m }
}

/// Returns the camera after a change of the world: its view of the scene stays the same.
pub(super) fn moved(camera: &Camera, by: &WorldFromScene) -> Camera {
    let pose = &camera.world_from_cam;
    Camera {
        world_from_cam: Pose::new(to_world(by, pose.translation_m), by.rotation * pose.rotation),
        near_m: camera.near_m * by.scale as f32,
        ..*camera
    }
}

/// Maximum distance of positions, as in an arena. [m]
const FARTHEST_M: f64 = 1e5;

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use proptest::prelude::*;

    use super::*;

    prop_compose! {
        fn place()(
            axis in prop::array::uniform3(-1.0..1.0f64), angle in -3.0..3.0f64,
            scale in 0.01..10.0f64, at in prop::array::uniform3(-9.0..9.0f64),
        ) -> WorldFromScene {
            let axis = DVec3::from(axis).normalize_or(DVec3::X);
            WorldFromScene {
                scale,
                rotation: DQuat::from_scaled_axis(axis * angle),
                translation_m: at.into(),
            }
        }
    }

    proptest! {
        #[test]
        fn a_point_has_the_same_position_by_both_placements(
            to in place(), from in place(), p in prop::array::uniform3(-5.0..5.0f64),
        ) {
            let direct = to_world(&to, p.into());
            let by_way = to_world(&between(&to, &from), to_world(&from, p.into()));
            prop_assert!(direct.distance(by_way) < 1e-6 * (1.0 + direct.length()));
            prop_assert!(Place::new(&to).world_from_scene().is_some());
        }
    }

    #[test]
    fn rejects_invalid_placements() {
        let good = Place::new(&WorldFromScene::IDENTITY);
        for bad in [
            Place { rotation: [0.0; 4], ..good },
            Place { rotation: [f64::NAN; 4], ..good },
            Place { metres_per_unit: 0.0, ..good },
            Place { metres_per_unit: f64::INFINITY, ..good },
            Place { origin: [0.0, f64::NAN, 0.0], ..good },
        ] {
            assert_eq!(bad.world_from_scene(), None, "{bad:?}");
        }
    }
}
