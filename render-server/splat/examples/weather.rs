//! Measures the cost of weather: processor time of each effect compared with that of a clear image, on one thread, so
//! that other load on the machine has little influence. Linux only: it reads /proc.
//!
//! ```text
//! cargo run --release -p vizflyt-splat --example weather -- SCENE.ply X Y Z YAW_DEG WIDTH
//! ```
//! The camera is at X Y Z, looks along x rotated by YAW_DEG about z, and has a field of view of 90 degrees.

use glam::{DMat3, DQuat, DVec3, Vec2, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::weather::{
    Cloud, Flicker, LampPlaces, Lamps, Moment, OwnLight, Rain, Snow, Sun, Weather, WeatherPass,
};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, ply};

const IMAGES: i64 = 15;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, place @ .., width] = &arguments[..] else {
        return Err("see the first lines of this file".into());
    };
    let place: Vec<f64> = place.iter().map(|text| text.parse()).collect::<Result<_, _>>()?;
    let [x, y, z, yaw_deg] = place[..] else { return Err("X Y Z YAW_DEG".into()) };
    let width_px: u32 = width.parse()?;
    let splats = ply::read(scene)?.splats;
    let ahead = DQuat::from_mat3(&DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X));
    let turn = DQuat::from_rotation_z(yaw_deg.to_radians()) * ahead;
    let k = Intrinsics::from_horizontal_fov(width_px, width_px * 3 / 4, 90_f64.to_radians());
    let camera = Camera::new(k, Pose::new(DVec3::new(x, y, z), turn), 0.05);
    let mut renderer = CpuRenderer::new(&splats);
    println!(
        "{scene}, {width_px}x{}, {}, one thread, processor ms of {IMAGES} images",
        k.height_px,
        renderer.name()
    );
    for (name, weather) in effects() {
        let mut images = [RgbdImage::default()];
        let mut pass = WeatherPass::default();
        let (mut clear_ms, mut weather_ms) = (Vec::new(), Vec::new());
        for image in 0..IMAGES {
            let moment = Moment { at_ns: image * 33_333_333, v_world_mps: DVec3::ZERO, seed: 7 };
            let start_ms = processor_ms()?;
            renderer.render(&[], &[camera], &mut images)?;
            let rendered_ms = processor_ms()?;
            pass.apply(&weather, &camera, &moment, &mut images[0]);
            clear_ms.push(rendered_ms - start_ms);
            weather_ms.push(processor_ms()? - rendered_ms);
        }
        let (clear_ms, weather_ms) = (median(clear_ms), median(weather_ms));
        let share = weather_ms / clear_ms * 100.0;
        println!("{name:<12} clear {clear_ms:5.1}  weather {weather_ms:5.2}  {share:3.0} %");
    }
    Ok(())
}

fn effects() -> [(&'static str, Weather); 9] {
    let clear = Weather::CLEAR;
    let cloud = Some(Cloud {
        per_m: 0.3,
        color: [0.6; 3],
        patchiness: 1.0,
        patch_m: 1.6,
        drift_mps: Vec3::new(0.25, 0.1, 0.15),
        layer_m: None,
        ball: None,
    });
    let rain = Some(Rain { rate_mmph: 60.0, wind_mps: Vec2::new(1.0, 0.5), lens_drops: 10 });
    let snow = Some(Snow { rate_mmph: 4.0, wind_mps: Vec2::new(0.6, 0.3) });
    let own_light = Some(OwnLight { reach_m: 3.0, color: [1.0; 3], cos_cone: 0.85 });
    let places = LampPlaces::Grid { height_m: 3.0, spacing_m: 4.0 };
    let lamps = Some(Lamps { reach_m: 1.1, color: [1.0, 0.8, 0.52], places });
    let sun = Some(Sun { direction: DVec3::X, glare: 1.0, color: [1.0; 3], behind_m: 0.5 });
    let flicker = Some(Flicker { mains_hz: 50.0, depth: 0.35, readout_s: 0.016 });
    [
        ("cloud", Weather { cloud, ..clear }),
        ("rain", Weather { rain, exposure_s: 0.002, ..clear }),
        ("snow", Weather { snow, ..clear }),
        ("sun", Weather { sun, ..clear }),
        ("lamps", Weather { lamps, ..clear }),
        ("own light", Weather { own_light, ..clear }),
        ("flicker", Weather { flicker, ..clear }),
        ("night snow", Weather { snow, own_light, ..clear }),
        ("cloud, rain", Weather { cloud, rain, exposure_s: 0.002, ..clear }),
    ]
}

/// Returns the total processor time of all threads (proc(5), schedstat). [ms]
fn processor_ms() -> Result<f64, Box<dyn std::error::Error>> {
    let mut total_ns = 0;
    for thread in std::fs::read_dir("/proc/self/task")? {
        let text = std::fs::read_to_string(thread?.path().join("schedstat"))?;
        total_ns += text.split(' ').next().unwrap_or("0").parse::<u64>()?;
    }
    Ok(total_ns as f64 * 1e-6)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
