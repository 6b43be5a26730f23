//! Placement of a captured scene in the world, once at load. `[scene]` of `arena.toml`, the options of a bare
//! scene and those of `scene convert` all use it.
//!
//! Means and scales are multiplied, rotations turned, and the spherical harmonics of degree 1 to 3 turned with
//! them, so that highlights stay at their places.

use glam::{DQuat, DVec3, Vec3};
use vizflyt_arena::config::{Geofence, SceneConfig};
use vizflyt_splat::Splats;
use vizflyt_splat::edit::transform;

/// Placement of a scene in the world: transform, then crop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    pub world_from_scene: WorldFromScene,
    /// Splats with their centres outside are removed. [m, world]
    pub crop: Option<Geofence>,
}

impl Placement {
    /// Leaves the scene unchanged.
    pub const IDENTITY: Self = Self { world_from_scene: WorldFromScene::IDENTITY, crop: None };

    /// Returns the placement of an arena's `[scene]`.
    pub fn of(scene: &SceneConfig) -> Self {
        let world_from_scene = WorldFromScene {
            scale: scene.metres_per_unit,
            rotation: scene.rotation(),
            translation_m: scene.origin_m,
        };
        Self { world_from_scene, crop: scene.crop }
    }

    /// Moves the splats into the world and crops them; returns the number of removed splats. An identity
    /// changes no bit.
    pub fn apply(&self, splats: &mut Splats) -> usize {
        self.world_from_scene.apply(splats);
        self.crop.map_or(0, |crop| keep_within(splats, &crop))
    }
}

/// Removes the splats with their centres outside a box; returns their number.
fn keep_within(splats: &mut Splats, crop: &Geofence) -> usize {
    let within = |mean: &Vec3| {
        let p_m = mean.as_dvec3();
        p_m.cmpge(crop.min_m).all() && p_m.cmple(crop.max_m).all()
    };
    let keep: Vec<bool> = splats.means_m.iter().map(within).collect();
    let before = splats.len();
    splats.keep(&keep);
    before - splats.len()
}

/// A similarity: `p_world = scale * (rotation * p_scene) + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WorldFromScene {
    /// World metres per scene unit.
    pub scale: f64,
    /// Rotation from scene axes to world axes.
    pub rotation: DQuat,
    /// Position of the scene's origin. [m, world]
    pub translation_m: DVec3,
}

impl WorldFromScene {
    /// Leaves the scene unchanged.
    pub const IDENTITY: Self =
        Self { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };

    /// Returns the position of a point of the scene. [m, world]
    pub fn point_m(&self, p_scene: DVec3) -> DVec3 {
        self.scale * (self.rotation * p_scene) + self.translation_m
    }

    /// Moves every splat into the world; an identity changes no bit.
    pub fn apply(&self, splats: &mut Splats) {
        if *self == Self::IDENTITY {
            return;
        }
        transform(splats, self.scale, self.rotation, self.translation_m);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_splat::{Atmosphere, Camera, render_reference};

    #[test]
    fn an_identity_placement_changes_no_bit() {
        let mut placed = scene();
        let placement = Placement::of(&"scene.ply".into());
        assert_eq!((placement, placement.apply(&mut placed)), (Placement::IDENTITY, 0));
        let bits = |splats: &Splats| {
            let vectors = splats.means_m.iter().chain(&splats.scales_m).flat_map(Vec3::to_array);
            let turns = splats.rotations.iter().flat_map(Quat::to_array);
            let rest = splats.opacities.iter().chain(&splats.sh).copied();
            vectors.chain(turns).chain(rest).map(f32::to_bits).collect::<Vec<_>>()
        };
        assert!(bits(&placed) == bits(&scene()));
    }

    #[test]
    fn cropped_splats_are_removed_with_all_their_data() {
        let config = SceneConfig {
            metres_per_unit: 2.0,
            crop: Some(Geofence { min_m: DVec3::splat(-1e3), max_m: DVec3::new(0.0, 1e3, 1e3) }),
            ..SceneConfig::in_world("a.ply")
        };
        let (whole, mut cropped) = (scene(), scene());
        let left_out = Placement::of(&config).apply(&mut cropped);
        let kept: Vec<usize> = (0..whole.len()).filter(|&k| whole.means_m[k].x <= 0.0).collect();
        assert!(kept.len() > 5 && left_out == whole.len() - kept.len() && left_out > 5);
        assert_eq!(cropped.len(), kept.len());
        for (k, &was) in kept.iter().enumerate() {
            assert_eq!(cropped.means_m[k], whole.means_m[was] * 2.0);
            assert_eq!(cropped.scales_m[k], whole.scales_m[was] * 2.0);
            assert!(cropped.rotations[k].abs_diff_eq(whole.rotations[was], 1e-6));
            assert_eq!(cropped.opacities[k], whole.opacities[was]);
            assert_eq!(cropped.sh[48 * k..][..48], whole.sh[48 * was..][..48]);
        }
    }

    fn scene() -> Splats {
        let count = 40;
        // Deterministic numbers in -1..1 without a generator.
        let noise = |k: usize| ((k as f32 * 12.9898).sin() * 43758.547).fract();
        Splats {
            means_m: (0..count)
                .map(|i| Vec3::new(noise(i), noise(i + 100), 3.0 + noise(i + 200)))
                .collect(),
            scales_m: (0..count)
                .map(|i| Vec3::new(0.05, 0.1, 0.2) * (1.5 + noise(i + 300)))
                .collect(),
            rotations: (0..count)
                .map(|i| Quat::from_xyzw(noise(i), noise(i + 1), noise(i + 2), 1.0).normalize())
                .collect(),
            opacities: (0..count).map(|i| 0.5 + 0.01 * i as f32).collect(),
            sh_degree: 3,
            sh: (0..count * 48).map(|i| noise(i) * 0.3).collect(),
            antialiased: false,
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]
        /// After moving scene and camera together, the image is the same; depth scales.
        #[test]
        fn a_moved_scene_looks_the_same_to_a_moved_camera(
            axis in prop::array::uniform3(-1.0..1.0f64), angle in -3.0..3.0f64,
            scale in 0.2..5.0f64, shift in prop::array::uniform3(-5.0..5.0f64),
        ) {
            let rotation = DQuat::from_scaled_axis(
                DVec3::from(axis).normalize_or(DVec3::X) * angle,
            );
            let similarity = WorldFromScene { scale, rotation, translation_m: shift.into() };
            let camera = Camera {
                intrinsics: Intrinsics::from_horizontal_fov(24, 18, 1.2),
                world_from_cam: Pose::IDENTITY,
                near_m: 0.01,
                background: [0.0; 3],
                atmosphere: Atmosphere::CLEAR,
            };
            let before = render_reference(&scene(), &[], &camera).unwrap();
            let mut moved = scene();
            similarity.apply(&mut moved);
            let camera = Camera {
                world_from_cam: Pose::new(similarity.translation_m, rotation),
                near_m: (0.01 * scale) as f32,
                ..camera
            };
            let after = render_reference(&moved, &[], &camera).unwrap();
            let mse: f32 = before.rgb.iter().zip(&after.rgb).map(|(a, b)| (a - b).powi(2)).sum::<f32>()
                / before.rgb.len() as f32;
            prop_assert!(mse < 1e-7, "mse {mse}");
            let depths = before.depth_expected_m.iter().zip(&after.depth_expected_m);
            let off = depths.filter(|(a, b)| (*a * scale as f32 - *b).abs() > 0.01 * *b).count();
            prop_assert!(off < before.depth_expected_m.len() / 50, "{off} depths off");
        }
    }
}
