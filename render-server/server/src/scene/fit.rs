//! Plausibility checks of a scene in its arena: a capture that lies on its side, far away or a hundred times
//! too large has no obstacles, and a course without obstacles can always be flown.
//!
//! ```text
//! Splats in the world, ArenaConfig, DistanceField -> findings, by key of arena.toml
//! ```
//! Certain faults: most of the scene is outside the fence, no level floor is under the start, no part became an
//! obstacle. Likely faults, for a scene rotated by `up`: it is upside down (objects in a room stand on its
//! floor), or on its side (higher than long). A wall that became the floor of a room with similar sides is not
//! detected.

use glam::DVec3;
use vizflyt_arena::check::Finding;
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_splat::Splats;

use super::core::{bounds, core};
use super::floor::{REACH_M, floor_share};

/// Returns the findings against a scene in its arena; `field` is its baked distance field.
pub fn check_fit(splats: &Splats, arena: &ArenaConfig, field: &DistanceField) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut found = |key: &str, text: String| findings.push(Finding { key: key.into(), text });
    let core = core(splats, |mean| mean);
    let outside = share_outside(&core, arena);
    if outside > MOST {
        found(
            "scene",
            format!(
                "{:.0} % of the scene lies outside the geofence; correct up, metres_per_unit and origin of \
                 [scene] or the geofence, or cut off with scene.crop what does not belong to it",
                100.0 * outside
            ),
        );
    }
    let start_m = arena.spawn.position_m;
    let covered = floor_share(splats, start_m, arena.occupancy.min_opacity as f32);
    if covered < LEAST_FLOOR && field.occupied_voxels() == 0 {
        found(
            "scene",
            "nothing of it is an obstacle in the geofence: 0 voxels are solid".to_owned(),
        );
    }
    if covered < LEAST_FLOOR {
        found(
            "spawn.position_m",
            format!(
                "the scene has no floor there: {:.0} % of {REACH_M} m around it lie level at {:.2} m; \
                 move the start, or correct up and origin of [scene]",
                100.0 * covered,
                start_m.z
            ),
        );
    }
    if let Some(up) = arena.scene.up.filter(|_| core.len() >= MIN_CORE) {
        let [min, max] = bounds(core.clone());
        let size_m = max - min;
        let otherwise = "; if it is as it should be, give rotation instead of up";
        if size_m.z > TALL * size_m.x.max(size_m.y) {
            let text = format!(
                "'{up}' makes the scene {:.1} m high and {:.1} x {:.1} m wide: it seems to lie on its \
                 side{otherwise}",
                size_m.z, size_m.x, size_m.y
            );
            found("scene.up", text);
        }
        let [low, high] = fullness(&core, min, max);
        if low < TOP_HEAVY * high {
            let text = format!(
                "with '{up}' more stands in the upper half ({:.0} %) than in the lower ({:.0} %): the scene \
                 seems to be upside down{otherwise}",
                100.0 * high,
                100.0 * low
            );
            found("scene.up", text);
        }
    }
    findings
}

/// Returns the share of points outside the fence with a margin for walls.
fn share_outside(points: &[glam::Vec3], arena: &ArenaConfig) -> f64 {
    let fence = &arena.geofence;
    let inside = points.iter().filter(|p| {
        let p_m = p.as_dvec3();
        p_m.cmpge(fence.min_m - WALL_M).all() && p_m.cmple(fence.max_m + WALL_M).all()
    });
    let inside = inside.count() as f64;
    if points.is_empty() { 0.0 } else { 1.0 - inside / points.len() as f64 }
}

/// Returns the share of coarse cells that contain a splat, between floor and ceiling, for the lower and the
/// upper half.
fn fullness(points: &[glam::Vec3], min: DVec3, max: DVec3) -> [f64; 2] {
    let size = max - min;
    let side = size.max_element() / CELLS;
    let count = (size / side).ceil().clamp(DVec3::ONE, DVec3::splat(CELLS)).as_uvec3();
    let mut full = vec![false; count.element_product() as usize];
    for p in points {
        let at = (p.as_dvec3() - min) / side;
        if at.cmpge(DVec3::ZERO).all() && at.cmplt(count.as_dvec3()).all() {
            let at = at.as_uvec3();
            full[((at.z * count.y + at.y) * count.x + at.x) as usize] = true;
        }
    }
    let layers: Vec<f64> = full
        .chunks_exact((count.x * count.y) as usize)
        .map(|layer| layer.iter().filter(|full| **full).count() as f64 / layer.len() as f64)
        .collect();
    let edge = layers.len().div_ceil(10);
    let between = layers.get(edge..layers.len().saturating_sub(edge)).unwrap_or_default();
    let half = between.len() / 2;
    let mean = |layers: &[f64]| layers.iter().sum::<f64>() / layers.len().max(1) as f64;
    [mean(&between[..half]), mean(&between[between.len() - half..])]
}

/// Maximum share outside the fence. Of a generated hall, 82 % are outside: its walls, behind the net.
const MOST: f64 = 0.95;
/// Margin for walls outside the fence. [m]
const WALL_M: f64 = 1.0;
/// Minimum share of level floor: captures have holes under objects.
pub(super) const LEAST_FLOOR: f64 = 0.5;
/// Minimum number of splats to judge the shape.
const MIN_CORE: usize = 1000;
/// Minimum ratio of height to width on its side: the captured room has 1.7 then, and 0.6 upright.
const TALL: f64 = 1.5;
/// Maximum ratio of lower to upper half when upside down: the captured room has 0.52 then, and 1.9 upright.
const TOP_HEAVY: f64 = 0.67;
/// Cells along the longest side.
const CELLS: f64 = 40.0;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, Quat, Vec3};
    use vizflyt_arena::BakeSpec;
    use vizflyt_arena::config::{SceneConfig, Spawn, Up};

    use super::super::bake::bake_with;
    use super::super::{WorldFromScene, default_arena};

    /// A room of 10 x 6 x 3 m, z up, of discs of 0.1 m: floor, ceiling, walls, and shelves of 1 m along one
    /// wall.
    fn room() -> Splats {
        let mut means_m = Vec::new();
        let mut rotations = Vec::new();
        let mut face = |normal: Vec3, corner: Vec3, u: Vec3, v: Vec3| {
            let (across, down) = ((u.length() / 0.1) as usize, (v.length() / 0.1) as usize);
            for k in 0..across * down {
                let (i, j) = ((k % across) as f32 + 0.5, (k / across) as f32 + 0.5);
                means_m.push(corner + u * (i / across as f32) + v * (j / down as f32));
                rotations.push(Quat::from_rotation_arc(Vec3::Z, normal));
            }
        };
        let (x, y, z) = (Vec3::X * 10.0, Vec3::Y * 6.0, Vec3::Z * 3.0);
        face(Vec3::Z, Vec3::ZERO, x, y);
        face(Vec3::Z, z, x, y);
        for (corner, normal, u) in
            [(Vec3::ZERO, Vec3::Y, x), (y, Vec3::Y, x), (Vec3::ZERO, Vec3::X, y), (x, Vec3::X, y)]
        {
            face(normal, corner, u, z);
        }
        for shelf in 1..=6 {
            let low = Vec3::new(0.5, 4.5, 0.2 * shelf as f32);
            face(Vec3::Z, low, Vec3::X * 9.0, Vec3::Y);
        }
        let count = means_m.len();
        Splats {
            antialiased: false,
            means_m,
            scales_m: vec![Vec3::new(0.1, 0.1, 0.01); count],
            rotations,
            opacities: vec![0.95; count],
            sh_degree: 0,
            sh: vec![0.5; 3 * count],
        }
    }

    /// Returns the room rotated so that its axis `up` points up, with its lowest point at 0 and its middle at
    /// the origin.
    fn turned(up: Up) -> (Splats, ArenaConfig) {
        let mut splats = room();
        let rotation = up.world_from_scene();
        let turn = WorldFromScene { rotation, ..WorldFromScene::IDENTITY };
        turn.apply(&mut splats);
        let [min, max] = bounds(splats.means_m.clone());
        let translation_m = -((min + max) / 2.0).with_z(min.z);
        WorldFromScene { translation_m, ..WorldFromScene::IDENTITY }.apply(&mut splats);
        let scene = SceneConfig { up: Some(up), ..SceneConfig::in_world("room.ply") };
        let mut arena = default_arena(&splats, scene).unwrap();
        arena.spawn = Spawn { position_m: DVec3::ZERO, yaw_deg: 0.0 };
        (splats, arena)
    }

    fn keys(splats: &Splats, arena: &ArenaConfig) -> Vec<String> {
        let field = bake_with(splats, &BakeSpec::of(arena), None, None, &|_| ()).field;
        let findings = check_fit(splats, arena, &field);
        findings.into_iter().map(|finding| finding.key).collect()
    }

    #[test]
    fn a_room_on_its_floor_fits() {
        let (splats, arena) = turned(Up::Z);
        assert_eq!(keys(&splats, &arena), [""; 0]);
    }

    #[test]
    fn detects_a_room_upside_down_or_on_its_side() {
        let (splats, mut arena) = turned(Up::NegZ);
        assert_eq!(keys(&splats, &arena), ["scene.up"]);
        // As written by a user who has aligned it.
        arena.scene.rotation = Some(DQuat::IDENTITY.to_array());
        arena.scene.up = None;
        assert_eq!(keys(&splats, &arena), [""; 0]);
        // 10 m high, at most 6 m wide.
        let (splats, arena) = turned(Up::X);
        assert!(keys(&splats, &arena).contains(&"scene.up".to_owned()));
    }

    #[test]
    fn detects_a_missing_floor_and_a_scene_elsewhere() {
        let (splats, arena) = turned(Up::Z);
        let moved = |by_m: Vec3, scale: f32| {
            let mut moved = splats.clone();
            moved.means_m.iter_mut().for_each(|mean| *mean = *mean * scale + by_m);
            keys(&moved, &arena)
        };
        // Half a room too low: the fence begins in mid-air.
        assert_eq!(moved(Vec3::NEG_Z * 1.5, 1.0), ["spawn.position_m"]);
        assert_eq!(moved(Vec3::X * 7.5, 1.0), ["spawn.position_m"]);
        assert_eq!(moved(Vec3::X * 500.0, 1.0), ["scene", "scene", "spawn.position_m"]);
        assert_eq!(moved(Vec3::ZERO, 100.0)[0], "scene");
    }

    #[test]
    fn detects_an_empty_scene() {
        let (_, arena) = turned(Up::Z);
        assert_eq!(keys(&Splats::default(), &arena), ["scene", "spawn.position_m"]);
    }
}
