//! Compares each model with its formula in scenes of one or a few planes, and tests invalid input.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Object, Pose, Sensor, World};

use super::noise::Draws;
use super::presets::{PRESETS, Preset, preset};
use super::*;
use crate::cpu::simd::InstructionSet;
use crate::{RigidObject, Scene, Splats};

mod reference;

/// Returns the splats of a white wall: discs on a grid in the plane through `center` with this
/// normal, `half_m` to each side.
pub(super) fn wall(center: Vec3, normal: Vec3, half_m: f32, step_m: f32) -> Splats {
    let (across, up) = normal.normalize().any_orthonormal_pair();
    let count = (half_m / step_m).ceil() as i32;
    let mut splats = Splats::default();
    for row in -count..=count {
        for column in -count..=count {
            let at = center + (across * column as f32 + up * row as f32) * step_m;
            add(&mut splats, at, normal, step_m * 0.6, 1.0);
        }
    }
    splats
}

/// Adds a grey disc.
fn add(splats: &mut Splats, mean_m: Vec3, normal: Vec3, sigma_m: f32, grey: f32) {
    splats.means_m.push(mean_m);
    splats.scales_m.push(Vec3::new(sigma_m, sigma_m, 1e-3));
    splats.rotations.push(Quat::from_rotation_arc(Vec3::Z, normal.normalize()));
    splats.opacities.push(0.99);
    splats.sh.extend([(grey - 0.5) / crate::harmonics::C0 as f32; 3]);
}

fn at(p_m: DVec3, yaw_rad: f64) -> Pose<World, Sensor> {
    Pose::new(p_m, DQuat::from_rotation_z(yaw_rad))
}

fn lidar_of(preset_name: &str) -> LidarModel {
    let Some(Preset::Lidar(model)) = preset(preset_name) else {
        panic!("{preset_name} is a LiDAR")
    };
    model
}

/// Returns the model of a LiDAR with one ring and without errors.
fn exact(columns: u32) -> LidarModel {
    LidarModel {
        beams: Beams::Spinning { elevations_rad: vec![0.0], columns },
        sigma_m: 0.0,
        sigma_per_m: 0.0,
        range_step_m: 0.0,
        min_range_m: 0.0,
        divergence_rad: 1e-4,
        ..lidar_of("vlp-16")
    }
}

fn scan(model: LidarModel, scene: &SensorScene, motion: &SensorMotion<'_>) -> Vec<LidarPoint> {
    let mut points = Vec::new();
    Lidar::new(model).unwrap().scan(scene, motion, 1, 2, &mut points).unwrap();
    points
}

#[test]
fn measures_the_distance_of_a_wall_along_every_beam() {
    let scene = SensorScene::new(&wall(Vec3::new(3.0, 0.0, 0.0), -Vec3::X, 3.0, 0.05));
    let points = scan(exact(360), &scene, &SensorMotion::standing(at(DVec3::ZERO, 0.0)));
    let mut seen = 0;
    for (column, point) in points.iter().enumerate() {
        let azimuth = std::f64::consts::PI * (1.0 - column as f64 / 180.0);
        if azimuth.abs() > 0.7 {
            // The wall ends at 45 degrees, and there is nothing behind it.
            assert!(azimuth.abs() < 0.8 || point.range_m == 0.0, "{azimuth}: {point:?}");
            continue;
        }
        seen += 1;
        let truth_m = 3.0 / azimuth.cos();
        assert!((f64::from(point.range_m) - truth_m).abs() < 2e-3, "{azimuth}: {point:?}");
        assert!((point.p_sensor_m[0] - 3.0).abs() < 2e-3, "{point:?}");
        // Lambert: the light reflected by white is proportional to the cosine of incidence.
        let intensity = 255.0 * azimuth.cos() as f32;
        assert!((point.intensity - intensity).abs() < 8.0, "{azimuth}: {point:?}");
    }
    assert!(seen > 70);
}

#[test]
fn measures_each_point_from_the_pose_at_its_instant() {
    let scene = SensorScene::new(&wall(Vec3::new(4.0, 0.0, 0.0), -Vec3::X, 3.0, 0.05));
    let moving = SensorMotion {
        world_from_sensor: [at(DVec3::ZERO, 0.0), at(DVec3::X, 0.0)],
        objects: &[],
        duration_s: 0.1,
    };
    let points = scan(exact(360), &scene, &moving);
    // The beam ahead leaves in the middle of the sweep: half the distance and half the time have
    // passed.
    assert!((points[180].range_m - 3.5).abs() < 2e-3, "{:?}", points[180]);
    assert!((i64::from(points[180].offset_ns) - 50_000_000).abs() < 10, "{:?}", points[180]);
    for (column, point) in points.iter().enumerate().filter(|(_, p)| p.range_m > 0.0) {
        let gone_m = column as f32 / 360.0;
        assert!((gone_m + point.p_sensor_m[0] - 4.0).abs() < 2e-3, "{column}: {point:?}");
    }
}

#[test]
fn range_errors_match_sigma_and_step() {
    let scene = SensorScene::new(&wall(Vec3::new(5.0, 0.0, 0.0), -Vec3::X, 1.0, 0.05));
    let lidar = Lidar::new(LidarModel {
        sigma_m: 0.01,
        sigma_per_m: 0.002,
        range_step_m: 0.004,
        ..exact(360)
    })
    .unwrap();
    let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
    let mut points = Vec::new();
    let mut ranges = Vec::new();
    for seq in 0..4000 {
        lidar.scan(&scene, &motion, 7, seq, &mut points).unwrap();
        ranges.push(f64::from(points[180].range_m));
    }
    let mean = ranges.iter().sum::<f64>() / ranges.len() as f64;
    let square = ranges.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / ranges.len() as f64;
    // 0.01 + 5 * 0.002; rounding adds a twelfth of the step's square.
    let sigma = (0.02_f64.powi(2) + 0.004_f64.powi(2) / 12.0).sqrt();
    assert!((mean - 5.0).abs() < 2e-3, "{mean}");
    assert!((square.sqrt() / sigma - 1.0).abs() < 0.05, "{}", square.sqrt());
    assert!(ranges.iter().all(|r| ((r / 0.004).round() * 0.004 - r).abs() < 1e-6));
}

#[test]
fn loses_returns_by_reflectivity_incidence_and_range() {
    // Detected with 90 % if reflectivity cos / range^2 equals that of the reference; rarely beyond.
    let share = |distance_m: f32, grey: f32, incidence_rad: f32| {
        let normal = Quat::from_rotation_z(incidence_rad) * -Vec3::X;
        let mut splats = wall(Vec3::new(distance_m, 0.0, 0.0), normal, 1.0, 0.05);
        let tone = (grey - 0.5) / crate::harmonics::C0 as f32;
        splats.sh.fill(tone);
        let scene = SensorScene::new(&splats);
        let lidar = Lidar::new(LidarModel {
            reference_range_m: 8.0,
            reference_reflectivity: 0.5,
            ..exact(8)
        })
        .unwrap();
        let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
        let mut points = Vec::new();
        let hits = (0..600).filter(|&seq| {
            lidar.scan(&scene, &motion, 1, seq, &mut points).unwrap();
            points[4].range_m > 0.0
        });
        hits.count() as f32 / 600.0
    };
    // sRGB values of linear 0.5 and 0.25.
    let (half, quarter) = (0.735, 0.537);
    assert!((share(8.0, half, 0.0) - 0.9).abs() < 0.06);
    // A wall of half the reflectivity at 1 / sqrt(2) of the range: as much light as the reference.
    assert!((share(8.0 / 2f32.sqrt(), quarter, 0.0) - 0.9).abs() < 0.06);
    // At 60 degrees, half of the light returns.
    assert!((share(8.0 / 2f32.sqrt(), half, 60f32.to_radians()) - 0.9).abs() < 0.07);
    assert!(share(4.0, half, 0.0) == 1.0);
    assert!(share(16.0, half, 0.0) < 0.1);
}

#[test]
fn a_beam_over_an_edge_has_an_echo_from_each_side() {
    // The near wall covers y > 0: half of a beam along x hits it.
    let mut splats = wall(Vec3::new(8.0, 0.0, 0.0), -Vec3::X, 1.0, 0.05);
    let mut near = wall(Vec3::new(4.0, 1.0, 0.0), -Vec3::X, 1.0, 0.004 * 5.0);
    near.means_m.iter_mut().for_each(|mean| mean.y += 0.01);
    splats.means_m.extend(near.means_m);
    splats.scales_m.extend(near.scales_m);
    splats.rotations.extend(near.rotations);
    splats.opacities.extend(near.opacities);
    splats.sh.extend(near.sh);
    let scene = SensorScene::new(&splats);
    let ahead = |returns, divergence_rad, y_m| {
        let model = LidarModel { divergence_rad, returns, ..exact(8) };
        scan(model, &scene, &SensorMotion::standing(at(DVec3::Y * y_m, 0.0)))[4].range_m
    };
    // A footprint of 0.1 rad is 0.4 m wide there.
    assert!((ahead(Returns::First, 0.1, 0.0) - 4.0).abs() < 0.01);
    assert!((ahead(Returns::Last, 0.1, 0.0) - 8.0).abs() < 0.05);
    // The near half is stronger, because it is nearer.
    assert!((ahead(Returns::Strongest, 0.1, 0.0) - 4.0).abs() < 0.01);
    // Three standard deviations (0.3 m) from the edge, there is only one side.
    assert!((ahead(Returns::Last, 0.1, 0.4) - 4.0).abs() < 0.01);
    assert!((ahead(Returns::First, 0.1, -0.4) - 8.0).abs() < 0.05);
    // A narrow beam hits one of them, and nothing in between.
    for y_m in [-0.1, -0.05, 0.05, 0.1] {
        let range_m = ahead(Returns::Strongest, 1e-4, y_m);
        assert!((range_m - if y_m < 0.0 { 8.0 } else { 4.0 }).abs() < 0.01, "{y_m}: {range_m}");
    }
}

/// Returns a scene of one object: a wall across x, 1 m to each side.
fn with_object() -> ([RigidObject; 1], Splats) {
    let splats = wall(Vec3::ZERO, -Vec3::X, 1.0, 0.05);
    ([RigidObject { id: 9, splats }], Splats::default())
}

// Why: the same type as placements.
#[allow(clippy::unnecessary_wraps)]
fn object_at(x_m: f64) -> Option<Pose<World, Object>> {
    Some(Pose::new(DVec3::X * x_m, DQuat::IDENTITY))
}

#[test]
fn measures_an_object_at_its_pose_at_the_instant_of_the_beam() {
    let (objects, splats) = with_object();
    let scene = SensorScene::new(Scene { splats: &splats, objects: &objects });
    let motion = SensorMotion {
        world_from_sensor: [at(DVec3::ZERO, 0.0); 2],
        objects: &[[object_at(5.0), object_at(4.0)]],
        duration_s: 0.1,
    };
    let point = scan(exact(360), &scene, &motion)[180];
    assert!((point.range_m - 4.5).abs() < 2e-3 && point.object == 9, "{point:?}");
    let gone = SensorMotion { objects: &[[object_at(5.0), None]], ..motion };
    assert_eq!(scan(exact(360), &scene, &gone)[180].range_m, 0.0);
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let scene = SensorScene::new(&wall(Vec3::new(3.0, 0.0, 0.0), -Vec3::X, 2.0, 0.1));
    let motion = SensorMotion {
        world_from_sensor: [at(DVec3::ZERO, 0.0), at(DVec3::new(0.2, 0.1, 0.0), 0.3)],
        objects: &[],
        duration_s: 0.1,
    };
    let Some(Preset::Radar(radar)) = preset("iwr6843") else { panic!("a radar") };
    let all = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut detections = Vec::new();
            let mut radar = Radar::new(radar.clone()).unwrap();
            radar.measure(&scene, &motion, 3, 4, &mut detections).unwrap();
            (scan(lidar_of("os1-16"), &scene, &motion), detections)
        })
    };
    let one = all(1);
    assert!(one.0.iter().filter(|p| p.range_m > 0.0).count() > 1000 && !one.1.is_empty());
    for threads in [2, 5] {
        assert!(all(threads) == one, "{threads} threads");
    }
}

#[test]
fn a_rosette_fills_its_field_without_repetition() {
    let lidar = Lidar::new(lidar_of("mid-360")).unwrap();
    let scene = SensorScene::new(&wall(Vec3::new(2.0, 0.0, 0.0), -Vec3::X, 4.0, 0.2));
    let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
    let cells = |points: &[LidarPoint]| -> std::collections::HashSet<(i32, i32)> {
        let seen = points.iter().filter(|p| p.range_m > 0.0);
        seen.map(|p| {
            let [x, y, z] = p.p_sensor_m;
            let elevation = (z / p.range_m).asin().to_degrees();
            ((y.atan2(x).to_degrees() / 1.0) as i32, elevation as i32)
        })
        .collect()
    };
    let mut points = Vec::new();
    let mut all = std::collections::HashSet::new();
    let mut counts = Vec::new();
    for seq in 0..6 {
        lidar.scan(&scene, &motion, 1, seq, &mut points).unwrap();
        all.extend(cells(&points));
        counts.push(all.len());
    }
    assert!(counts.windows(2).all(|w| w[1] > w[0]), "each sweep covers new cells: {counts:?}");
    assert!(all.iter().all(|&(_, elevation)| (-7..=52).contains(&elevation)));
}

fn range_of(name: &str) -> RangeFinder {
    let Some(Preset::Range(model)) = preset(name) else { panic!("{name} is a range finder") };
    RangeFinder::new(RangeModel { sigma_m: 0.0, sigma_per_m: 0.0, ..model }).unwrap()
}

fn sonar_of(name: &str) -> Sonar {
    let Some(Preset::Sonar(model)) = preset(name) else { panic!("{name} is a sonar") };
    Sonar::new(SonarModel { sigma_m: 0.0, sigma_per_m: 0.0, ..model }).unwrap()
}

#[test]
fn a_range_finder_reports_the_mean_range_within_its_cone() {
    for (name, distance_m) in [("tfmini", 5.0), ("lidar-lite-v3", 20.0), ("vl53l1x", 2.0)] {
        let finder = range_of(name);
        let scene = SensorScene::new(&wall(Vec3::X * distance_m, -Vec3::X, 2.0, 0.05));
        let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
        let reading = finder.measure(&scene, &motion, 1, 1).unwrap();
        // Over a cone of half angle a, the mean of 1 / cos is 1 + a^2 / 4 to second order.
        let half = finder.model().fov_rad / 2.0;
        let mean_m = distance_m * (1.0 + half * half / 4.0);
        let step_m = finder.model().range_step_m;
        assert!((reading.range_m - mean_m).abs() < 0.51 * step_m + 2e-3, "{name}: {reading:?}");
        let far = SensorMotion::standing(at(DVec3::NEG_X * 60.0, 0.0));
        assert_eq!(finder.measure(&scene, &far, 1, 1).unwrap(), RangeReading::default());
    }
}

#[test]
fn a_sonar_measures_the_nearest_surface_that_faces_it() {
    let sonar = sonar_of("mb1242");
    let heard = |splats: &Splats, seq| {
        let scene = SensorScene::new(splats);
        let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
        sonar.measure(&scene, &motion, 1, seq).unwrap()
    };
    let square = heard(&wall(Vec3::X * 3.0, -Vec3::X, 2.5, 0.1), 1);
    assert!((square.range_m - 3.0).abs() <= 0.011, "{square:?}");
    // Rotated by 20 degrees: the foot of the perpendicular, at 3 cos(20), is still at the edge of
    // the cone, but the echo is weaker.
    let turned = heard(&wall(Vec3::X * 3.0, Quat::from_rotation_z(0.35) * -Vec3::X, 2.5, 0.1), 1);
    assert!(turned.range_m == 0.0 || turned.range_m < 3.0, "{turned:?}");
    assert!(turned.strength < 0.5 * square.strength, "{turned:?} {square:?}");
    // At 65 degrees, all sound is reflected away.
    let oblique = heard(&wall(Vec3::X * 5.0, Quat::from_rotation_z(1.13) * -Vec3::X, 1.0, 0.1), 1);
    assert_eq!(oblique.range_m, 0.0);
    // Distances below the minimum range read as the minimum range.
    let near = heard(&wall(Vec3::X * 0.1, -Vec3::X, 0.5, 0.02), 1);
    assert!((near.range_m - 0.2).abs() < 1e-6, "{near:?}");
    // A quarter of the power at twice the range, and absorption by air both ways: 2 * 1.4 dB/m.
    let (two, four) = (
        heard(&wall(Vec3::X * 2.0, -Vec3::X, 3.0, 0.1), 1).strength,
        heard(&wall(Vec3::X * 4.0, -Vec3::X, 3.0, 0.1), 1).strength,
    );
    let expected_db = 20.0 * 2f32.log10() + 2.0 * 1.4 * 2.0;
    assert!((10.0 * (two / four).log10() - expected_db).abs() < 1.5, "{two} {four}");
}

fn radar_of(name: &str) -> RadarModel {
    let Some(Preset::Radar(model)) = preset(name) else { panic!("{name} is a radar") };
    model
}

#[test]
fn a_radar_measures_range_azimuth_and_speed_of_a_moving_object() {
    let (objects, splats) = with_object();
    let scene = SensorScene::new(Scene { splats: &splats, objects: &objects });
    let mut radar = Radar::new(radar_of("iwr6843")).unwrap();
    let mut detections = Vec::new();
    // The object approaches at 2 m/s, the sensor moves at 0.5 m/s: the distance decreases by 2.5
    // m/s.
    let motion = SensorMotion {
        world_from_sensor: [at(DVec3::ZERO, 0.0), at(DVec3::X * 0.025, 0.0)],
        objects: &[[object_at(5.0), object_at(4.9)]],
        duration_s: 0.05,
    };
    radar.measure(&scene, &motion, 1, 1, &mut detections).unwrap();
    let best = detections.iter().max_by(|a, b| a.snr_db.total_cmp(&b.snr_db)).unwrap();
    let halfway_m = 4.95 - 0.0125;
    assert!((best.range_m - halfway_m).abs() < 0.1, "{best:?}");
    assert!(best.azimuth_rad.abs() < 0.27, "{best:?}");
    assert!((best.speed_mps + 2.5).abs() < 0.1, "{best:?}");
    assert_eq!(best.object, 9);
    // Along every ray, the speed is that along the axis times the cosines of azimuth and elevation;
    // folded above 4.5 m/s.
    for detection in &detections {
        let along = detection.speed_mps / detection.azimuth_rad.cos();
        assert!((-2.7..-2.2).contains(&along), "{detection:?}");
    }
    let fast = SensorMotion { objects: &[[object_at(5.0), object_at(4.7)]], ..motion };
    radar.measure(&scene, &fast, 1, 1, &mut detections).unwrap();
    let best = detections.iter().max_by(|a, b| a.snr_db.total_cmp(&b.snr_db)).unwrap();
    // An approach at 6.5 m/s reads as 9 - 6.5 m/s away from the radar.
    assert!((2.4..2.8).contains(&best.speed_mps), "{best:?}");
}

#[test]
fn static_surfaces_have_speeds_of_the_cosine_of_their_bearing() {
    // A wall to the left of a sensor that flies parallel to it.
    let scene = SensorScene::new(&wall(Vec3::new(3.0, 2.0, 0.0), -Vec3::Y, 3.0, 0.1));
    let mut radar = Radar::new(RadarModel { threshold_db: 3.0, ..radar_of("iwr6843") }).unwrap();
    let mut detections = Vec::new();
    let motion = SensorMotion {
        world_from_sensor: [at(DVec3::ZERO, 0.0), at(DVec3::X * 0.05, 0.0)],
        objects: &[],
        duration_s: 0.05,
    };
    radar.measure(&scene, &motion, 1, 1, &mut detections).unwrap();
    assert!(!detections.is_empty());
    for detection in detections.iter().filter(|d| d.snr_db > 12.0) {
        let expected_mps = -detection.azimuth_rad.cos();
        assert!((detection.speed_mps - expected_mps).abs() < 0.12, "{detection:?}");
        assert_eq!(detection.object, 0);
    }
}

#[test]
fn the_signal_of_a_target_falls_with_the_fourth_power_of_range() {
    // One plate, smaller than every beam: its cross section is the same from all directions.
    let snr_db = |distance_m: f64| {
        let mut splats = Splats::default();
        add(&mut splats, Vec3::ZERO, -Vec3::X, 0.1, 1.0);
        let objects = [RigidObject { id: 3, splats }];
        let still = Splats::default();
        let scene = SensorScene::new(Scene { splats: &still, objects: &objects });
        let place = object_at(distance_m);
        let motion = SensorMotion {
            world_from_sensor: [at(DVec3::ZERO, 0.0); 2],
            objects: &[[place, place]],
            duration_s: 0.0,
        };
        let mut radar =
            Radar::new(RadarModel { reference_range_m: 40.0, ..radar_of("iwr6843") }).unwrap();
        let mut detections = Vec::new();
        let mut sum = 0.0;
        for seq in 0..50 {
            radar.measure(&scene, &motion, 1, seq, &mut detections).unwrap();
            let power = detections.iter().map(|d| 10f32.powf(d.snr_db / 10.0)).sum::<f32>();
            sum += power / 50.0;
        }
        10.0 * sum.log10()
    };
    let lost_db = snr_db(3.0) - snr_db(6.0);
    assert!((lost_db - 40.0 * 2f32.log10()).abs() < 1.5, "{lost_db}");
}

#[test]
fn presets_are_valid_and_have_unique_names() {
    let mut seen = std::collections::HashSet::new();
    for (name, about, model) in PRESETS {
        assert!(seen.insert(name) && !about.is_empty(), "{name}");
        match model() {
            Preset::Lidar(model) => assert!(Lidar::new(model).unwrap().beams() >= 64, "{name}"),
            Preset::Range(model) => drop(RangeFinder::new(model).unwrap()),
            Preset::Sonar(model) => drop(Sonar::new(model).unwrap()),
            Preset::Radar(model) => drop(Radar::new(model).unwrap()),
        }
        assert_eq!(preset(name), Some(model()));
    }
    assert_eq!(preset("vlp"), None);
    assert!(super::presets::names().contains("os1-64, mid-360"));
    let error = Lidar::new(LidarModel { sigma_m: f32::NAN, ..exact(8) }).unwrap_err().to_string();
    assert_eq!(error, "lidar: sigma_m is NaN; give 0 to 10");
}

#[test]
fn handles_an_empty_scene_no_beams_and_invalid_poses() {
    let nothing = SensorScene::new(&Splats::default());
    let motion = SensorMotion::standing(at(DVec3::ZERO, 0.0));
    assert!(scan(exact(8), &nothing, &motion).iter().all(|p| p.range_m == 0.0));
    assert!(scan(exact(0), &nothing, &motion).is_empty());
    let no_rings = Beams::Spinning { elevations_rad: Vec::new(), columns: 8 };
    assert!(scan(LidarModel { beams: no_rings, ..exact(8) }, &nothing, &motion).is_empty());
    let reading = range_of("tfmini").measure(&nothing, &motion, 1, 1).unwrap();
    assert_eq!(reading, RangeReading::default());
    assert_eq!(
        sonar_of("mb1242").measure(&nothing, &motion, 1, 1).unwrap(),
        RangeReading::default()
    );

    let lidar = Lidar::new(exact(8)).unwrap();
    let mut points = vec![LidarPoint::default()];
    let bad = SensorMotion::standing(at(DVec3::new(f64::NAN, 0.0, 0.0), 0.0));
    let error = lidar.scan(&nothing, &bad, 1, 1, &mut points).unwrap_err();
    assert!(error.to_string().contains("the sensor is at") && points.is_empty(), "{error}");
    let long = SensorMotion { duration_s: f64::NAN, ..motion };
    assert!(matches!(
        lidar.scan(&nothing, &long, 1, 1, &mut points),
        Err(SensorError::Duration(_))
    ));
    let (objects, splats) = with_object();
    let scene = SensorScene::new(Scene { splats: &splats, objects: &objects });
    let bad = SensorMotion { objects: &[[object_at(f64::INFINITY), None]], ..motion };
    let error = lidar.scan(&scene, &bad, 1, 1, &mut points).unwrap_err().to_string();
    assert!(error.contains("object 0 is placed at"), "{error}");
}

fn poison() -> impl Strategy<Value = f32> {
    prop_oneof![
        4 => -3.0..3.0f32,
        1 => prop::sample::select(vec![
            0.0, -0.0, 1e-40, 1e20, -1e20, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, f32::NAN,
        ]),
    ]
}

fn poisoned_splats() -> impl Strategy<Value = Splats> {
    let splat = (
        prop::array::uniform3(poison()),
        prop::array::uniform3(poison()),
        prop::array::uniform4(-1.0..1.0f32),
        poison(),
    );
    prop::collection::vec(splat, 0..80).prop_map(|all| {
        let mut splats = Splats::default();
        for (mean, scale, q, opacity) in all {
            splats.means_m.push(mean.into());
            splats.scales_m.push(Vec3::from(scale).abs());
            splats.rotations.push(Quat::from_array(q).normalize());
            splats.opacities.push(opacity);
            splats.sh.extend([mean[0], 0.0, scale[1]]);
        }
        splats
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    /// For any scene, every sensor returns finite readings within its range.
    #[test]
    fn reports_only_finite_values(splats in poisoned_splats(), x in -2.0..2.0f64, yaw in -3.0..3.0f64, seq: u64) {
        let scene = SensorScene::new(&splats);
        let motion = SensorMotion {
            world_from_sensor: [at(DVec3::X * x, yaw), at(DVec3::Y * x, yaw)],
            objects: &[],
            duration_s: 0.1,
        };
        for point in scan(LidarModel { divergence_rad: 0.01, ..exact(64) }, &scene, &motion) {
            let numbers = [point.range_m, point.intensity, point.p_sensor_m[0], point.p_sensor_m[1]];
            prop_assert!(numbers.iter().all(|v| v.is_finite()), "{:?}", point);
            prop_assert!((0.0..=100.0).contains(&point.range_m), "{:?}", point);
        }
        for reading in [
            range_of("vl53l1x").measure(&scene, &motion, 1, seq).unwrap(),
            sonar_of("hc-sr04").measure(&scene, &motion, 1, seq).unwrap(),
        ] {
            prop_assert!((0.0..=4.0).contains(&reading.range_m) && !reading.strength.is_nan(), "{:?}", reading);
        }
        let mut detections = Vec::new();
        Radar::new(radar_of("iwr6843")).unwrap().measure(&scene, &motion, 1, seq, &mut detections).unwrap();
        for d in detections {
            prop_assert!([d.range_m, d.azimuth_rad, d.speed_mps, d.snr_db].iter().all(|v| v.is_finite()), "{:?}", d);
        }
    }
}
