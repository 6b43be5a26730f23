//! Arenas of scenes larger than memory. The renderer reads the packed file from the disk; obstacles, beams, map
//! and page get the splats near the fence.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use glam::{DVec3, Vec3};
use tracing::info;
use vizflyt_arena::ArenaConfig;
use vizflyt_arena::config::Geofence;
use vizflyt_splat::{PackedScene, Splats};

use super::{Named, Placement, Scene, WorldFromScene, named, parse_arena, read_objects, seen};

/// Margin around the fence in which splats are loaded: the range of beams, map and page. [m]
const NEAR_M: f64 = 30.0;
/// Maximum splats near the fence: about 60 bytes each, and as much again for beams and the page.
const MOST: usize = 8_000_000;

/// Loads an arena of a packed scene.
pub(super) fn near(arena: ArenaConfig, arena_toml: &Path, scene: PathBuf) -> Result<Scene> {
    if arena.scene.antialiased.is_some() || Placement::of(&arena.scene) != Placement::IDENTITY {
        bail!(
            "{}: a packed scene lies where it was packed; remove all keys of [scene] except the file, and let \
             `vizflyt scene pack` place it: it takes the arena.toml of the scene that is packed",
            arena_toml.display()
        );
    }
    let cannot = || format!("cannot use scene {}", scene.display());
    let mut packed = PackedScene::open(&scene).with_context(cannot)?;
    let Geofence { min_m, max_m } = arena.geofence;
    let corners = [min_m - NEAR_M, max_m + NEAR_M].map(DVec3::as_vec3);
    let splats = within(&mut packed, corners).with_context(cannot)?;
    info!(
        "{}: {} splats on the disk, {} near the fence in memory",
        arena.scene.file,
        packed.len(),
        splats.len()
    );
    Ok(Scene {
        objects: read_objects(&arena, arena_toml)?,
        seen: seen::read(&arena, &scene)?,
        arena,
        splats,
        world_from_scene: WorldFromScene::IDENTITY,
        packed: Some(scene),
    })
}

fn within(packed: &mut PackedScene, [min_m, max_m]: [Vec3; 2]) -> Result<Splats> {
    let splats = packed.splats_within(min_m, max_m, MOST).context("the fence is too large")?;
    if splats.is_empty() {
        bail!("no splat is within {NEAR_M} m of the fence; are both in metres, in one frame?");
    }
    Ok(splats)
}

/// Returns the scene file of a path (an arena's, or the path itself), and the function that puts its splats
/// into the world: by an arena's `[scene]`; a scene file stays unchanged.
///
/// # Errors
/// Files that cannot be read or used.
pub fn placed(path: &Path) -> Result<(PathBuf, impl Fn(&mut Splats) + use<>)> {
    let (scene, placement, antialiased) = match named(path)? {
        Named::Arena(path) => {
            let (arena, scene) = parse_arena(&path)?;
            (scene, Placement::of(&arena.scene), arena.scene.antialiased)
        }
        Named::Scene(path) => (path, Placement::IDENTITY, None),
    };
    let place = move |splats: &mut Splats| {
        splats.antialiased = antialiased.unwrap_or(splats.antialiased);
        placement.apply(splats);
    };
    Ok((scene, place))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::load_to_fly;
    use glam::Quat;
    use vizflyt_splat::{Detail, pack, ply};

    const ARENA: &str = r#"name = "lab"
scene = SCENE
body_radius_m = 0.1
takeoff_height_m = 1.0
time_limit_s = 0.0
[spawn]
position_m = [0.0, 0.0, 0.0]
yaw_deg = 0.0
[geofence]
min_m = [-2.0, -2.0, -0.5]
max_m = [2.0, 2.0, 3.0]
[limits]
max_speed_mps = 1.0
max_acceleration_mps2 = 2.0
[[cameras]]
name = "front"
width_px = 64
height_px = 48
horizontal_fov_deg = 90.0
position_m = [0.1, 0.0, 0.0]
"#;

    /// Splats in a file's frame, in centimetres and with -y up.
    fn dots(places: &[[f32; 3]]) -> Splats {
        Splats {
            means_m: places.iter().copied().map(Vec3::from).collect(),
            scales_m: vec![Vec3::splat(2.0); places.len()],
            rotations: vec![Quat::IDENTITY; places.len()],
            opacities: vec![0.9; places.len()],
            sh: vec![0.5; places.len() * 3],
            ..Splats::default()
        }
    }

    #[test]
    fn keeps_its_placement_and_loads_splats_near_the_fence() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let write = |name: &str, scene: &str| {
            std::fs::write(at(name), ARENA.replace("SCENE", scene)).unwrap();
            at(name)
        };
        // One splat 2 m up, one outside the fence, one 50 m away.
        let splats = dots(&[[100.0, -200.0, 0.0], [2000.0, -100.0, 0.0], [5000.0, -100.0, 0.0]]);
        ply::write(at("scene.ply"), &splats).unwrap();
        let turned = r#"{ file = "scene.ply", up = "-y", metres_per_unit = 0.01 }"#;
        let (scene, place) = placed(&write("turned.toml", turned)).unwrap();
        let packed = at("scene.packed");
        pack(&scene, &packed, Detail::ADAPTIVE_PX, place, |_| ()).unwrap();

        let bare = crate::scene::BareArgs::default();
        let expected = load_to_fly(&at("turned.toml"), &bare).unwrap();
        assert!(expected.packed.is_none() && expected.splats.len() == 3);
        let named = write("packed.toml", r#""scene.packed""#);
        let loaded = load_to_fly(&named, &bare).unwrap();
        assert_eq!(loaded.packed, Some(packed));
        // In the order of blocks.
        let mut means_m = loaded.splats.means_m.clone();
        means_m.sort_by(|a, b| b.y.total_cmp(&a.y));
        assert_eq!(means_m, expected.splats.means_m[..2]);
        assert!((means_m[0].z - 2.0).abs() < 1e-5, "{}", means_m[0]);
        assert!(loaded.splats.scales_m[0].abs_diff_eq(expected.splats.scales_m[0], 1e-6));

        let refused = |name: &str, scene: &str| {
            format!("{:#}", load_to_fly(&write(name, scene), &bare).unwrap_err())
        };
        let moved = refused("moved.toml", r#"{ file = "scene.packed", up = "-y" }"#);
        assert!(moved.contains("a packed scene lies where it was packed"), "{moved}");
        pack(&at("scene.ply"), &at("raw.packed"), Detail::ADAPTIVE_PX, |_| (), |_| ()).unwrap();
        let lost = refused("lost.toml", r#""raw.packed""#);
        assert!(lost.contains("no splat is within 30 m of the fence"), "{lost}");
        std::fs::write(at("cut.packed"), &std::fs::read(at("raw.packed")).unwrap()[..60]).unwrap();
        let cut = refused("cut.toml", r#""cut.packed""#);
        assert!(cut.contains("cannot use scene") && cut.contains("cut or damaged"), "{cut}");
    }
}
