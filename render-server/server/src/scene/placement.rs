//! Puts a captured scene into the world, once at load: `[scene]` of `arena.toml`, the flags of a bare scene and
//! of `scene convert` all end here.
//!
//! Means and scales are multiplied, rotations turned, and the spherical harmonics of degree 1 to 3
//! turned with them, so that highlights stay where they were. The harmonics of a degree mix only
//! among themselves; the mixing matrix follows from f(R d) = f'(d) at enough directions, which
//! needs no closed form and holds for any sign convention of the basis.

use glam::{DQuat, DVec3, Vec3};
use vizflyt_arena::config::{Geofence, SceneConfig};
use vizflyt_splat::Splats;

/// How a scene comes to lie in the world: moved there, then cropped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Turns, scales and moves it.
    pub world_from_scene: WorldFromScene,
    /// Splats whose centres lie outside are left out. [m, world]
    pub crop: Option<Geofence>,
}

impl Placement {
    /// Leaves everything where it is.
    pub const IDENTITY: Self = Self { world_from_scene: WorldFromScene::IDENTITY, crop: None };

    /// Returns the placement that an arena's `[scene]` asks for.
    pub fn of(scene: &SceneConfig) -> Self {
        let world_from_scene = WorldFromScene {
            scale: scene.metres_per_unit,
            rotation: scene.rotation(),
            translation_m: scene.origin_m,
        };
        Self { world_from_scene, crop: scene.crop }
    }

    /// Moves the splats into the world and leaves out what is cropped; returns how many that were. Where
    /// there is nothing to do, every bit stays.
    pub fn apply(&self, splats: &mut Splats) -> usize {
        self.world_from_scene.apply(splats);
        self.crop.map_or(0, |crop| keep_within(splats, &crop))
    }
}

/// Leaves out the splats whose centres lie outside a box; returns how many.
fn keep_within(splats: &mut Splats, crop: &Geofence) -> usize {
    let within = |mean: &Vec3| {
        let p_m = mean.as_dvec3();
        p_m.cmpge(crop.min_m).all() && p_m.cmple(crop.max_m).all()
    };
    let keep: Vec<bool> = splats.means_m.iter().map(within).collect();
    let before = splats.len();
    let numbers = splats.sh_coefficients() * 3;
    retain(&mut splats.sh, &keep, numbers);
    retain(&mut splats.means_m, &keep, 1);
    retain(&mut splats.scales_m, &keep, 1);
    retain(&mut splats.rotations, &keep, 1);
    retain(&mut splats.opacities, &keep, 1);
    before - splats.len()
}

/// Keeps the blocks of `width` values that are to be kept, in order.
fn retain<T: Copy>(values: &mut Vec<T>, keep: &[bool], width: usize) {
    let mut end = 0;
    for (block, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
        values.copy_within(block * width..(block + 1) * width, end);
        end += width;
    }
    values.truncate(end);
}

/// A similarity: `p_world = scale * (rotation * p_scene) + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WorldFromScene {
    /// World metres per scene unit.
    pub scale: f64,
    /// Scene axes to world axes.
    pub rotation: DQuat,
    /// Where the scene's origin comes to lie. [m, world]
    pub translation_m: DVec3,
}

impl WorldFromScene {
    /// Leaves everything where it is.
    pub const IDENTITY: Self =
        Self { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };

    /// Moves every splat into the world; where nothing is to be moved, every bit stays.
    pub fn apply(&self, splats: &mut Splats) {
        if *self == Self::IDENTITY {
            return;
        }
        let rotation = self.rotation.as_quat();
        for mean in &mut splats.means_m {
            let p = self.rotation * mean.as_dvec3() * self.scale + self.translation_m;
            *mean = p.as_vec3();
        }
        for scale in &mut splats.scales_m {
            *scale *= self.scale as f32;
        }
        for axes in &mut splats.rotations {
            *axes = (rotation * *axes).normalize();
        }
        turn_harmonics(&mut splats.sh, splats.sh_degree, self.rotation);
    }
}

/// Turns the harmonics of every splat; coefficient by coefficient, RGB within.
fn turn_harmonics(sh: &mut [f32], degree: u8, rotation: DQuat) {
    let degree = usize::from(degree);
    if degree == 0 || rotation == DQuat::IDENTITY {
        return;
    }
    let mixes: Vec<_> = (1..=degree).map(|band| mixing_matrix(band, rotation)).collect();
    for splat in sh.chunks_exact_mut((degree + 1).pow(2) * 3) {
        for (mix, band) in mixes.iter().zip(1..) {
            let width = 2 * band + 1;
            let coefficients = &mut splat[band * band * 3..][..width * 3];
            for channel in 0..3 {
                let mut old = [0.0f32; 7];
                for (value, rgb) in old.iter_mut().zip(coefficients.chunks_exact(3)) {
                    *value = rgb[channel];
                }
                for (row, rgb) in mix.iter().zip(coefficients.chunks_exact_mut(3)) {
                    rgb[channel] = row.iter().zip(&old[..width]).map(|(a, b)| a * b).sum();
                }
            }
        }
    }
}

/// Returns M with `c_world = M c_scene` for degree `band`: the least-squares solution of
/// `sum_i c_world_i Y_i(R d) = sum_i c_scene_i Y_i(d)` over a sphere full of directions d, which is
/// exact, because a degree's harmonics are closed under rotation.
fn mixing_matrix(band: usize, rotation: DQuat) -> Vec<Vec<f32>> {
    let width = 2 * band + 1;
    // Normal equations: (A'^T A') M = A'^T A.
    let mut system = vec![vec![0.0f64; 2 * width]; width];
    for k in 0..DIRECTIONS {
        // A Fibonacci sphere: even cover without two directions alike.
        let z = 1.0 - (2.0 * k as f64 + 1.0) / DIRECTIONS as f64;
        let angle = k as f64 * std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
        let r = (1.0 - z * z).sqrt();
        let d = DVec3::new(r * angle.cos(), r * angle.sin(), z);
        let (scene, world) = (harmonics(band, d), harmonics(band, rotation * d));
        for i in 0..width {
            for j in 0..width {
                system[i][j] += world[i] * world[j];
                system[i][width + j] += world[i] * scene[j];
            }
        }
    }
    // Gauss-Jordan; the left half is symmetric positive definite, so no pivoting is needed.
    for i in 0..width {
        let pivot = system[i][i];
        system[i].iter_mut().for_each(|value| *value /= pivot);
        let row = system[i].clone();
        for (j, other) in system.iter_mut().enumerate().filter(|(j, _)| *j != i) {
            debug_assert_ne!(j, i);
            let factor = other[i];
            other.iter_mut().zip(&row).for_each(|(a, b)| *a -= factor * b);
        }
    }
    system.into_iter().map(|row| row[width..].iter().map(|&v| v as f32).collect()).collect()
}

/// Returns the basis functions of one degree in the order and signs of 3DGS files. Common factors
/// of a degree cancel in [`mixing_matrix`]; relative ones do not.
fn harmonics(band: usize, d: DVec3) -> [f64; 7] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    match band {
        1 => [-y, z, -x, 0.0, 0.0, 0.0, 0.0],
        2 => [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            0.0,
            0.0,
        ],
        _ => [
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ],
    }
}

/// Many more than the seven unknowns of a row.
const DIRECTIONS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_splat::{Atmosphere, Camera, render_reference};

    #[test]
    fn a_scene_in_the_world_keeps_every_bit() {
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
    fn what_lies_outside_the_crop_is_left_out_with_all_that_belongs_to_it() {
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
        /// A scene moved, seen by a camera moved along with it, looks the same; depth scales.
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
