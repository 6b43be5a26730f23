//! Compares LiDAR ranges in the splats of generated scenes with rays cast at their true geometry.

use vizflyt_protocol::geometry::Sensor;
use vizflyt_splat::sensor::{
    Beams, Lidar, LidarModel, LidarPoint, SensorMotion, SensorScene, presets,
};

use super::*;

/// Range errors of beams that hit the true geometry within 20 m inside a volume.
#[derive(Debug, Default)]
struct Strayed {
    /// Range errors on obstacles: trunks, logs, boulders, walls, frames. [m]
    obstacles_m: Vec<f64>,
    /// Distances of points from the floor. [m]
    floor_m: Vec<f64>,
    lost: usize,
}

/// Returns a VLP-16 without noise, with 1024 columns, and its 16 elevations.
fn exact() -> (LidarModel, Vec<f32>) {
    let model =
        LidarModel { sigma_m: 0.0, range_step_m: 0.0, min_range_m: 0.0, ..presets::vlp_16() };
    let Beams::Spinning { elevations_rad, .. } = &model.beams else { panic!("it spins") };
    let elevations_rad = elevations_rad.clone();
    (model, elevations_rad)
}

/// Returns the distance along a ray to the true geometry, and whether it is the floor.
fn cast(solids: &Solids, within: &Volume, p_m: DVec3, ray: DVec3) -> Option<(f64, bool)> {
    let mut along_m = 0.0;
    for _ in 0..600 {
        let q_m = p_m + ray * along_m;
        if along_m > 20.0 || within.signed_distance_m(q_m) > 0.0 {
            return None;
        }
        let d = solids.distance_m(q_m).min(REACH_M);
        if d < 2e-4 {
            return Some((along_m, solids.distance_to_bodies_m(q_m) > 5e-3));
        }
        along_m += d;
    }
    None
}

fn measure(scene: &Generated, within: &Volume, places: &[DVec3]) -> Strayed {
    let solids = Solids::new(scene.truth.clone());
    let packed = SensorScene::new(&scene.splats);
    let (model, elevations_rad) = exact();
    let lidar = Lidar::new(model).unwrap();
    let mut points: Vec<LidarPoint> = Vec::new();
    let mut strayed = Strayed::default();
    for &p_m in places {
        let world_from_sensor: Pose<World, Sensor> = Pose::new(p_m, DQuat::IDENTITY);
        lidar.scan(&packed, &SensorMotion::standing(world_from_sensor), 1, 1, &mut points).unwrap();
        for (i, point) in points.iter().enumerate().step_by(3) {
            let azimuth = core::f64::consts::TAU * (0.5 - (i / 16) as f64 / 1024.0);
            let elevation = f64::from(elevations_rad[i % 16]);
            let beam = |left: f64, up: f64| {
                let (azimuth, elevation) = (azimuth + left, elevation + up);
                let level = DVec2::from_angle(azimuth) * elevation.cos();
                cast(&solids, within, p_m, level.extend(elevation.sin()))
            };
            let Some((truth_m, floor)) = beam(0.0, 0.0) else { continue };
            // Beams within two standard deviations of their footprint from an outline hit both sides.
            let edge = 1.5e-3;
            let outline =
                [(edge, 0.0), (-edge, 0.0), (0.0, edge), (0.0, -edge)].iter().any(|&(l, u)| {
                    beam(l, u).is_none_or(|(m, of_floor)| {
                        of_floor != floor || (m - truth_m).abs() > 0.1 * truth_m
                    })
                });
            if outline {
                continue;
            }
            if point.range_m == 0.0 {
                strayed.lost += 1;
                continue;
            }
            if floor {
                let q_m = DVec3::from(point.p_sensor_m.map(f64::from)) + p_m;
                strayed.floor_m.push(solids.distance_m(q_m).abs());
            } else {
                strayed.obstacles_m.push((f64::from(point.range_m) - truth_m).abs());
            }
        }
    }
    strayed
}

/// Returns the quantile of a share.
fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share) as usize]
}

fn check(name: &str, mut strayed: Strayed) {
    let obstacles = strayed.obstacles_m.len();
    let [median, most] = [0.5, 0.95].map(|share| quantile(&mut strayed.obstacles_m, share));
    let [floor, most_floor] = [0.5, 0.95].map(|share| quantile(&mut strayed.floor_m, share));
    println!(
        "{name}: {obstacles} beams on obstacles, median {median:.4} m, 95 % within {most:.4} m; {} on the floor, \
         {floor:.4} m and {most_floor:.4} m from it; {} lost",
        strayed.floor_m.len(),
        strayed.lost
    );
    assert!(obstacles > 500, "{name}");
    assert!(median <= 0.01 && most <= 0.03, "{name}: {median} {most}");
    // The floor is painted some centimetres below its true height, because images use the depth of a splat's centre.
    assert!(floor <= 0.03 && most_floor <= 0.06, "{name}: {floor} {most_floor}");
    assert!(
        strayed.lost * 100 <= obstacles + strayed.floor_m.len(),
        "{name}: {} lost",
        strayed.lost
    );
}

#[test]
fn ranges_in_the_forest_agree_with_the_truth() {
    let places: Vec<DVec3> = (0..7)
        .map(|n| {
            let t = f64::from(n);
            DVec3::new(2.0 + 5.5 * t, 0.8 * (t * 1.7).sin(), 1.3)
        })
        .collect();
    for seed in [7, 11] {
        let forest = forest::build_bare(seed);
        let fence = forest.arena.geofence();
        check(&format!("forest {seed}"), measure(&forest, &fence, &places));
    }
}

#[test]
fn ranges_in_the_hall_agree_with_the_truth() {
    let places = [
        DVec3::new(0.9, 0.0, 1.2),
        DVec3::new(3.2, 0.9, 1.6),
        DVec3::new(5.0, -0.8, 1.3),
        DVec3::new(8.1, -0.6, 1.5),
    ];
    let scene = generate(SceneKind::Race, 7);
    let fence = scene.arena.geofence();
    check("race 7", measure(&scene, &fence, &places));
}
