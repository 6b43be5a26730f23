//! The CPU renderer allocates only while its buffers grow, for any poses, cameras, lenses, and appearing or absent
//! objects. The same applies to the image sensors and the beam sensors.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DQuat, DVec3, Quat, Vec2, Vec3};
use rayon::{ThreadPool, ThreadPoolBuilder};
use vizflyt_fixtures::CountingAllocator;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Object, Pose, World};
use vizflyt_splat::imaging::exposure::ExposureControl;
use vizflyt_splat::imaging::mosaic::ColorFilter;
use vizflyt_splat::imaging::noise::NoiseKey;
use vizflyt_splat::imaging::stereo::Stereo;
use vizflyt_splat::imaging::tof::Tof;
use vizflyt_splat::imaging::{CameraModel, DepthModel, Imager, Sensor, Shot};
use vizflyt_splat::sensor::presets::{PRESETS, Preset};
use vizflyt_splat::sensor::{
    Lidar, LidarPoint, Radar, RadarDetection, RangeFinder, SensorMotion, SensorScene, Sonar,
};
use vizflyt_splat::weather::{
    Cloud, Flicker, LampPlaces, Lamps, Moment, OwnLight, Rain, Snow, Sun, Weather, WeatherPass,
};
use vizflyt_splat::{
    Camera, CpuRenderer, Placement, Rasterizer, RgbdImage, RigidObject, Scene, Splats,
};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Thread pool that counts only the allocations of its threads, because tests run concurrently in one process.
struct Pool {
    threads: ThreadPool,
    count: &'static AtomicUsize,
}

impl Pool {
    fn new() -> Self {
        let count: &'static AtomicUsize = Box::leak(Box::default());
        let threads = ThreadPoolBuilder::new()
            .num_threads(3)
            .start_handler(move |_| CountingAllocator::count_in(count))
            .build()
            .expect("a pool");
        // A thread allocates when it starts, which can be delayed on a loaded machine: this waits for all of them.
        threads.broadcast(|_| ());
        Self { threads, count }
    }

    /// Runs `work` on the pool's own threads: rayon allocates a little to accept work from outside.
    fn install<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        self.threads.install(work)
    }

    fn allocations(&self) -> usize {
        self.count.load(Ordering::Relaxed)
    }
}

/// Returns `count` splats in all directions, up to 4 m away.
fn cloud(count: u32, half_m: f32) -> Splats {
    let mut splats = Splats::default();
    for i in 0..count {
        // Fractions of multiples of irrational numbers: evenly spread and reproducible.
        let spread = |k: f64| (f64::from(i) * k).fract() as f32 * 2.0 - 1.0;
        let at = Vec3::new(spread(0.618_034), spread(0.414_214), spread(0.732_051));
        splats.means_m.push(at * half_m);
        splats.scales_m.push(Vec3::new(0.03, 0.02, 0.01));
        splats.rotations.push(Quat::from_rotation_x(spread(0.236_068)));
        splats.opacities.push(0.7);
        splats.sh.extend(at.to_array());
    }
    splats
}

fn cameras(turn: u32) -> Vec<Camera> {
    let pinhole = Intrinsics::from_horizontal_fov(160, 120, 1.4);
    let small = Intrinsics::from_horizontal_fov(99, 55, 1.0);
    let barrel = Distortion::BrownConrady { k1: -0.2, k2: 0.04, p1: 0.001, p2: 0.0, k3: 0.0 };
    let fisheye = Distortion::KannalaBrandt { k1: 0.01, k2: 0.0, k3: 0.0, k4: 0.0 };
    let angle_rad = f64::from(turn) * 0.5;
    let rotation =
        DQuat::from_rotation_y(angle_rad) * DQuat::from_rotation_x(0.3 * angle_rad.sin());
    let position_m = DVec3::new(angle_rad.cos(), 0.2, angle_rad.sin());
    [
        pinhole,
        Intrinsics { distortion: barrel, ..pinhole },
        Intrinsics { distortion: fisheye, ..small },
        // Outside the scene: the buffers are empty.
        pinhole,
    ]
    .into_iter()
    .enumerate()
    .map(|(i, intrinsics)| {
        Camera::new(
            intrinsics,
            Pose::new(position_m * if i == 3 { 1e4 } else { 1.0 }, rotation),
            0.05,
        )
    })
    .collect()
}

fn placements(turn: u32) -> [Placement; 2] {
    let world_from_object = |k: u32| -> Option<Pose<World, Object>> {
        (!turn.is_multiple_of(k + 2)).then(|| {
            let rotation = DQuat::from_rotation_z(f64::from(turn));
            Pose::new(DVec3::new(0.0, 0.0, f64::from(turn % 5)), rotation)
        })
    };
    [world_from_object(0), world_from_object(1)]
}

#[test]
fn allocates_nothing_after_the_first_pass_over_all_views() {
    const TURNS: u32 = 13;
    let splats = cloud(60_000, 4.0);
    let objects = [1, 2].map(|id| RigidObject { id, splats: cloud(2000, 0.5) });
    let calls: Vec<_> = (0..TURNS).map(|turn| (placements(turn), cameras(turn))).collect();
    let pool = Pool::new();
    for mut renderer in CpuRenderer::every(Scene { splats: &splats, objects: &objects }) {
        let mut images = vec![RgbdImage::default(); calls[0].1.len()];
        let counts = pool.install(|| {
            [(); 4].map(|()| {
                let before = pool.allocations();
                for (placements, cameras) in &calls {
                    renderer.render(placements, cameras, &mut images).expect("a valid call");
                }
                pool.allocations() - before
            })
        });
        assert!(counts[0] > 0, "the counter counts");
        assert_eq!(counts[1..], [0, 0, 0], "{}", renderer.name());
    }
    // Also checks the sensor effects on these images.
    let mut renderer = CpuRenderer::new(&splats);
    let camera = calls[1].1[0];
    let mut clean = [RgbdImage::default()];
    renderer.render(&[], &[camera], &mut clean).expect("a valid call");
    for model in models() {
        let (mut imager, mut image) = (Imager::default(), clean[0].clone());
        let counts = pool.install(|| {
            [(); 3].map(|()| {
                let before = pool.allocations();
                for seq in 0..TURNS {
                    image.rgb.copy_from_slice(&clean[0].rgb);
                    image.alpha.copy_from_slice(&clean[0].alpha);
                    image.depth_median_m.copy_from_slice(&clean[0].depth_median_m);
                    let path = |at_s: f64| {
                        let moved = Pose::new(DVec3::X * at_s, DQuat::from_rotation_y(at_s));
                        camera.world_from_cam * moved
                    };
                    let key = NoiseKey::new(1, 2, u64::from(seq));
                    let shot =
                        Shot { camera: &camera, path: &path, at_s: f64::from(seq) / 30.0, key };
                    imager.apply(&model, &shot, &mut image);
                }
                pool.allocations() - before
            })
        });
        assert_eq!(counts[1..], [0, 0], "{model:?}");
    }
}

fn models() -> [CameraModel; 2] {
    let sensor = |filter| Sensor {
        full_well_e: 4000.0,
        read_noise_e: 3.0,
        electrons_per_s: 40_000.0,
        bits: 10,
        filter,
        denoise: true,
        noise: true,
        vignette: 0.3,
        readout_s: 0.02,
        exposure: ExposureControl::Auto {
            aim: 0.18,
            lag_s: 0.3,
            least_shutter_s: 1e-5,
            most_shutter_s: 0.03,
            most_gain: 10.0,
        },
    };
    let stereo = Stereo {
        baseline_m: 0.05,
        focal_px: 446.8,
        subpixel_px: 0.08,
        most_disparity_px: 126.0,
        most_m: 10.0,
        fattening_px: 3.0,
        least_texture: 0.02,
    };
    let tof = Tof {
        modulation_hz: 20e6,
        unambiguous_m: 7.5,
        least_m: 0.1,
        most_m: 7.5,
        signal_e_1m: 40_000.0,
        background_e: 0.0,
        contrast: 0.8,
        least_signal_e: 100.0,
        multipath: true,
    };
    [
        CameraModel { sensor: Some(sensor(ColorFilter::Bayer)), depth: DepthModel::Stereo(stereo) },
        CameraModel { sensor: Some(sensor(ColorFilter::Rgb)), depth: DepthModel::Tof(tof) },
    ]
}

#[test]
fn sensors_allocate_nothing_after_the_first_pass() {
    let splats = cloud(20_000, 4.0);
    let objects = [1, 2].map(|id| RigidObject { id, splats: cloud(500, 0.5) });
    let scene = SensorScene::new(Scene { splats: &splats, objects: &objects });
    let pool = Pool::new();
    // Motions of the sensor and the objects; one object appears and disappears.
    let turns: Vec<_> = (0..7).map(|turn| (placements(turn), placements(turn + 1))).collect();
    for (name, _, preset) in PRESETS {
        let mut sensor = Prepared::new(preset());
        let counts = pool.install(|| {
            [(); 3].map(|()| {
                let before = pool.allocations();
                for (seq, (begin, end)) in turns.iter().enumerate() {
                    let moved_m = DVec3::X * (0.1 * seq as f64);
                    let begins = Pose::new(moved_m, DQuat::from_rotation_z(0.3 * seq as f64));
                    let ends = Pose::new(moved_m + DVec3::Y * 0.2, begins.rotation);
                    let motion = SensorMotion {
                        world_from_sensor: [begins, ends],
                        objects: &[[begin[0], end[0]], [begin[1], end[1]]],
                        duration_s: 0.1,
                    };
                    sensor.measure(&scene, &motion, seq as u64);
                }
                pool.allocations() - before
            })
        });
        // Beams hit a cloud in all directions: the records have grown in the first pass.
        assert_eq!(counts[1..], [0, 0], "{name}");
    }
}

/// Sensor with its output buffer.
enum Prepared {
    Lidar(Lidar, Vec<LidarPoint>),
    Range(RangeFinder),
    Sonar(Sonar),
    Radar(Radar, Vec<RadarDetection>),
}

impl Prepared {
    fn new(preset: Preset) -> Self {
        match preset {
            Preset::Lidar(model) => Self::Lidar(Lidar::new(model).expect("a model"), Vec::new()),
            Preset::Range(model) => Self::Range(RangeFinder::new(model).expect("a model")),
            Preset::Sonar(model) => Self::Sonar(Sonar::new(model).expect("a model")),
            Preset::Radar(model) => Self::Radar(Radar::new(model).expect("a model"), Vec::new()),
        }
    }

    fn measure(&mut self, scene: &SensorScene, motion: &SensorMotion<'_>, seq: u64) {
        let valid = "a valid motion";
        match self {
            Self::Lidar(lidar, points) => {
                lidar.scan(scene, motion, 1, seq, points).expect(valid);
                assert!(
                    points.iter().any(|point| point.range_m > 0.0),
                    "the cloud is not detected"
                );
            }
            Self::Range(finder) => drop(finder.measure(scene, motion, 1, seq).expect(valid)),
            Self::Sonar(sonar) => drop(sonar.measure(scene, motion, 1, seq).expect(valid)),
            Self::Radar(radar, found) => {
                radar.measure(scene, motion, 1, seq, found).expect(valid);
            }
        }
    }
}

#[test]
fn weather_allocates_nothing_after_the_first_pass_over_all_views() {
    const TURNS: u32 = 13;
    let weather = Weather {
        cloud: Some(Cloud {
            per_m: 0.3,
            color: [0.6; 3],
            patchiness: 1.0,
            patch_m: 1.0,
            drift_mps: Vec3::X,
            layer_m: None,
            ball: None,
        }),
        rain: Some(Rain { rate_mmph: 40.0, wind_mps: Vec2::ONE, lens_drops: 10 }),
        snow: Some(Snow { rate_mmph: 3.0, wind_mps: Vec2::ONE }),
        sun: Some(Sun { direction: DVec3::X, glare: 1.0, color: [1.0; 3], behind_m: 9.0 }),
        lamps: Some(Lamps {
            reach_m: 1.0,
            color: [1.0; 3],
            places: LampPlaces::Grid { height_m: 3.0, spacing_m: 4.0 },
        }),
        own_light: Some(OwnLight { reach_m: 2.0, color: [1.0; 3], cos_cone: 0.8 }),
        flicker: Some(Flicker { mains_hz: 50.0, depth: 0.3, readout_s: 0.01 }),
        depth_loss: true,
        ..Weather::CLEAR
    };
    let pool = Pool::new();
    let mut pass = WeatherPass::default();
    let mut images = [(); 4].map(|()| RgbdImage::default());
    let counts = pool.install(|| {
        [(); 4].map(|()| {
            let mut allocations = 0;
            for turn in 0..TURNS {
                let cameras = cameras(turn);
                let at_ns = i64::from(turn) * 33_000_000;
                let shot = Moment { at_ns, v_world_mps: DVec3::X, seed: 7 };
                let before = pool.allocations();
                for (camera, image) in cameras.iter().zip(&mut images) {
                    image.resize(camera.intrinsics.width_px, camera.intrinsics.height_px);
                    image.alpha.fill(1.0);
                    image.depth_expected_m.fill(5.0);
                    image.depth_median_m.fill(5.0);
                    pass.apply(&weather, camera, &shot, image);
                }
                allocations += pool.allocations() - before;
            }
            allocations
        })
    });
    assert!(counts[0] > 0, "the counter counts");
    assert_eq!(counts[1..], [0, 0, 0]);
}
