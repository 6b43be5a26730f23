//! `vizflyt scene events`: simulates the events of an event camera along a path through an arena.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use clap::Args;
use vizflyt_arena::ArenaConfig;
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_server::render::environment::atmosphere;
use vizflyt_server::render::{DetailKind, RendererKind, choose};
use vizflyt_server::scene::{load_as_it_is, load_objects};
use vizflyt_splat::imaging::events::{EventCamera, EventSensor};
use vizflyt_splat::{Camera, Chosen, RgbdImage, Scene};

use crate::evaluate;

/// Simulate an event camera on a path
#[derive(Args, Debug)]
#[command(
    after_help = "The model is ESIM's: a pixel reports each time that the logarithm of its brightness has changed by
--contrast since it last did, at the instant found by interpolation between images. Lines are
`seconds x y polarity`, as of the event camera data set of the University of Zurich; time counts from
the path's first pose, polarity is 1 for brighter and 0 for darker.

Examples:
  vizflyt export flights/NAME.mcap --format euroc -o flight
  vizflyt scene events forest/arena.toml --path flights/NAME.mcap#/pose -o events.txt
  vizflyt scene events race/arena.toml --path track.tum --camera rear --rate 2000 --contrast 0.15 -o e.txt"
)]
pub(crate) struct EventsArgs {
    /// arena.toml with scene and cameras
    arena: PathBuf,
    /// Seed of the initial phase of objects that set none
    #[arg(long, help_heading = "Scene", default_value_t = 7)]
    seed: u64,
    /// Poses of the vehicle's body: TUM text, EuRoC CSV or FLIGHT.mcap#TOPIC
    #[arg(long, help_heading = "Path", value_name = "PATH")]
    path: String,
    /// Start time on the path
    #[arg(long, help_heading = "Path", value_name = "SECONDS", default_value_t = 0.0)]
    from: f64,
    /// Duration on the path [default: to the end]
    #[arg(long, help_heading = "Path", value_name = "SECONDS")]
    seconds: Option<f64>,
    /// Camera of the arena [default: the first one]
    #[arg(long, help_heading = "Event camera", value_name = "NAME")]
    camera: Option<String>,
    /// Change of the natural logarithm of a pixel's brightness that causes an event
    #[arg(long, help_heading = "Event camera", value_name = "LN", default_value_t = 0.2, value_parser = contrast)]
    contrast: f32,
    /// Dead time of a pixel after an event
    #[arg(long, help_heading = "Event camera", value_name = "MICROSECONDS", default_value_t = 0)]
    dead: u32,
    /// Rate of rendered images; motion between two should be less than a pixel
    #[arg(long, help_heading = "Rendering", value_name = "HZ", default_value_t = 1000.0, value_parser = rate)]
    rate: f64,
    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// File to write
    #[arg(short, long, help_heading = "Output", value_name = "FILE")]
    out: PathBuf,
}

fn rate(text: &str) -> Result<f64, String> {
    let hz: f64 = text.parse().map_err(|_| format!("'{text}' is not a rate"))?;
    (1.0..=1e6).contains(&hz).then_some(hz).ok_or_else(|| "give 1 to 1000000 Hz".to_owned())
}

fn contrast(text: &str) -> Result<f32, String> {
    let ln: f32 = text.parse().map_err(|_| format!("'{text}' is not a contrast"))?;
    (0.01..=5.0).contains(&ln).then_some(ln).ok_or_else(|| "give 0.01 to 5".to_owned())
}

/// Runs `vizflyt scene events`.
pub(super) fn run(args: &EventsArgs) -> Result<()> {
    let text = std::fs::read_to_string(&args.arena)
        .with_context(|| format!("cannot read {} as an arena.toml", args.arena.display()))?;
    let arena = ArenaConfig::parse(&text)?;
    let config = match &args.camera {
        None => arena.cameras.first(),
        Some(name) => arena.cameras.iter().find(|camera| camera.name == *name),
    };
    let names: Vec<_> = arena.cameras.iter().map(|camera| camera.name.as_str()).collect();
    let config =
        config.with_context(|| format!("no such camera; there are {}", names.join(", ")))?;
    let info = config.info();
    let path = evaluate::read(&args.path)?;
    let (first_s, last_s) = (path[0].at_s, path[path.len() - 1].at_s);
    let span_s = (last_s - first_s - args.from).min(args.seconds.unwrap_or(f64::INFINITY));
    ensure!(
        args.from >= 0.0 && span_s > 0.0,
        "the path is {:.3} s long: --from {} s is after its end",
        last_s - first_s,
        args.from
    );
    let (_, loaded) = load_as_it_is(&args.arena)?;
    let (objects, moving) = load_objects(&args.arena, args.seed)?;
    let twin = Scene { splats: &loaded.splats, objects: &objects };
    let Chosen { mut rasterizer, .. } = choose(twin, args.renderer, DetailKind::Full)?;
    let file =
        File::create(&args.out).with_context(|| format!("cannot write {}", args.out.display()))?;
    let mut out = BufWriter::new(file);
    let sensor = EventSensor {
        threshold_on: args.contrast,
        threshold_off: args.contrast,
        dead_ns: u64::from(args.dead) * 1000,
        ..EventSensor::default()
    };
    let atmosphere = atmosphere(&arena.environment);
    let (mut events, mut camera) = (Vec::new(), EventCamera::default());
    let (mut images, mut written) = ([RgbdImage::default()], [0u64; 2]);
    let count = (span_s * args.rate) as u64;
    for n in 0..=count {
        let since_s = args.from + n as f64 / args.rate;
        let at = evaluate::interpolated(&path, first_s + since_s);
        let world_from_body: Pose<World, Body> = Pose::new(at.position_m, at.rotation);
        let seen = Camera {
            atmosphere,
            ..Camera::new(
                info.intrinsics,
                world_from_body * info.body_from_cam,
                config.near_m as f32,
            )
        };
        let at_ns = (since_s * 1e9).round() as u64;
        rasterizer.render(&moving.placements(at_ns.cast_signed()), &[seen], &mut images)?;
        events.clear();
        camera.push(&sensor, &images[0], at_ns, &mut events);
        for event in &events {
            let (s, ns) = (event.t_ns / 1_000_000_000, event.t_ns % 1_000_000_000);
            writeln!(out, "{s}.{ns:09} {} {} {}", event.x, event.y, u8::from(event.on))?;
            written[usize::from(event.on)] += 1;
        }
    }
    out.flush().with_context(|| format!("cannot write {}", args.out.display()))?;
    let [darker, brighter] = written;
    print_fmt!(
        "{}: {} images of {span_s:.3} s, {brighter} events of brighter and {darker} of darker pixels",
        args.out.display(),
        count + 1
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};
    use vizflyt_splat::Splats;

    use super::*;

    const ARENA: &str = r#"
name = "ball"
scene = "ball.ply"
body_radius_m = 0.12
takeoff_height_m = 1.2
spawn = { position_m = [0, 0, 0] }
geofence = { min_m = [-5, -5, -0.5], max_m = [5, 5, 4] }
limits = { max_speed_mps = 6.0, max_acceleration_mps2 = 8.0 }
[[cameras]]
name = "front"
width_px = 64
height_px = 48
horizontal_fov_deg = 90.0
position_m = [0, 0, 0]
"#;

    #[test]
    fn a_passing_ball_causes_events_at_both_edges() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        // A white ball, 2 m in front of the middle of the path.
        let ball = Splats {
            means_m: vec![Vec3::new(2.0, 0.0, 1.0)],
            scales_m: vec![Vec3::splat(0.1)],
            rotations: vec![Quat::IDENTITY],
            opacities: vec![0.99],
            sh_degree: 0,
            sh: vec![1.7; 3],
            antialiased: false,
        };
        vizflyt_splat::format::write(file("ball.ply"), &ball).unwrap();
        std::fs::write(file("arena.toml"), ARENA).unwrap();
        // The vehicle moves 0.5 m to the left in 0.5 s.
        std::fs::write(file("path.tum"), "5.0 0 -0.25 1 0 0 0 1\n5.5 0 0.25 1 0 0 0 1\n").unwrap();
        let mut args = EventsArgs {
            arena: file("arena.toml"),
            path: file("path.tum").display().to_string(),
            camera: None,
            rate: 200.0,
            contrast: 0.2,
            dead: 0,
            from: 0.0,
            seconds: None,
            seed: 7,
            renderer: RendererKind::Cpu,
            out: file("events.txt"),
        };
        run(&args).unwrap();
        let text = std::fs::read_to_string(&args.out).unwrap();
        let events: Vec<Vec<f64>> = text
            .lines()
            .map(|line| line.split(' ').map(|cell| cell.parse().unwrap()).collect())
            .collect();
        assert!(events.len() > 100, "{}", events.len());
        assert!(events.is_sorted_by(|a, b| a[0] <= b[0]) && events[events.len() - 1][0] <= 0.5);
        // The ball moves to the right in the image: pixels at its right edge get brighter, at its left edge darker.
        let mean_x = |on: f64| {
            let of = events.iter().filter(|event| event[3] == on && (0.2..0.3).contains(&event[0]));
            let (sum, count) =
                of.fold((0.0, 0.0), |(sum, count), event| (sum + event[1], count + 1.0));
            sum / count
        };
        assert!(mean_x(1.0) > 32.0 && mean_x(0.0) < 32.0, "{} {}", mean_x(1.0), mean_x(0.0));
        args.camera = Some("rear".to_owned());
        assert!(run(&args).unwrap_err().to_string().contains("no such camera; there are front"));
        args.from = 0.6;
        args.camera = None;
        assert!(run(&args).unwrap_err().to_string().contains("--from 0.6 s is after its end"));
    }
}
