//! `vizflyt gym`: courses as reinforcement-learning environments, many at once, for `vizflyt.Env` of the Python
//! package.
//!
//! ```text
//! Python ─ stdin ──▶ reset flags, seeds, actions ──▶ Episodes, stepped on all cores
//!        ◀ stdout ── states, figures, ends, images ◀─ one batch of cameras, one renderer a course
//! ```
//! Runs as a separate process, so that Python's interpreter lock does not block it, a crash does not affect the
//! notebook, and the wheel contains simulator and renderer only once. The first output is a line of JSON with the sizes
//! of all parts. Each step then takes and returns that number of bytes, little-endian. The process ends when its input
//! ends. The same seeds and actions give the same bytes.

mod draw;
pub mod episode;
#[cfg(test)]
mod tests;

use std::io::{self, BufWriter, Read, Write};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use clap::{Args, ValueEnum};
use rayon::prelude::*;
use serde_json::json;
use vizflyt_scenes::Variant;
use vizflyt_scenes::projects::{CourseProject, Level, NAMES};
use vizflyt_simulator::autopilot::airframe_limits;
use vizflyt_studio::course::CourseInstance;
use vizflyt_studio::scene::camera::ImageSize;

use self::draw::{Drawn, View};
use crate::episode::{ACTION, ActionKind, Episode, FIGURES, Manner, Rules, STATE, append};

/// Rate of the controllers. [Hz]
const TICKS_HZ: u32 = 400;

/// Fly courses for a learning program; Python's `vizflyt.Env` starts it
#[derive(Args, Debug)]
pub struct GymArgs {
    #[arg(long, help_heading = "Scene", value_name = "NAME", help = format!(
        "Project: {}; or FILE.toml", NAMES.join(", ")
    ))]
    project: String,
    /// Courses to fly, by their seeds
    #[arg(
        long,
        help_heading = "Scene",
        value_delimiter = ',',
        value_name = "SEED,...",
        default_value = "1"
    )]
    courses: Vec<u64>,
    /// Light and weather
    #[arg(long, help_heading = "Scene", value_name = "NAME", default_value = "day")]
    variant: Variant,
    /// Number of vehicles, each in a separate episode
    #[arg(long, help_heading = "Flight", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=4096))]
    envs: u32,
    /// Quantity that an action commands
    #[arg(long, help_heading = "Flight", value_enum, default_value_t)]
    action: Action,
    /// Steps per second
    #[arg(long, help_heading = "Flight", value_name = "HZ", default_value_t = 40, value_parser = clap::value_parser!(u32).range(10..=400))]
    rate: u32,
    /// Steps until an action takes effect
    #[arg(long, help_heading = "Flight", value_name = "STEPS", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=40))]
    delay: u32,
    /// Maximum time of an episode
    #[arg(long, help_heading = "Flight", value_name = "SECONDS", default_value_t = 30.0)]
    seconds: f64,
    /// Image size; images are of the first camera of the course
    #[arg(long, help_heading = "Rendering", value_name = "WxH")]
    camera: Option<ImageSize>,
    /// Horizontal field of view (default: that of the course's camera)
    #[arg(long, help_heading = "Rendering", value_name = "DEGREES", requires = "camera")]
    fov: Option<f64>,
    /// Layers of the images
    #[arg(
        long,
        help_heading = "Rendering",
        value_enum,
        value_delimiter = ',',
        default_value = "depth",
        requires = "camera"
    )]
    layers: Vec<Layer>,
    /// Maximum position error of rendered splats; 0 renders every splat exactly
    #[arg(long, help_heading = "Rendering", value_name = "PX", default_value_t = 0.7, value_parser = error_px)]
    error_px: f32,
}

fn error_px(text: &str) -> Result<f32, String> {
    let px: f32 = text.parse().map_err(|_| format!("'{text}' is not a number of pixels"))?;
    (0.0..=10.0).contains(&px).then_some(px).ok_or_else(|| "give 0 to 10 px".to_owned())
}

/// Quantity that an action commands. Its numbers are from -1 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Action {
    /// Velocity forward, left and up, as fractions of the course's limit, and a turn
    #[default]
    Velocity,
    /// Acceleration forward, left and up, as fractions of the course's limit, and a turn
    Acceleration,
    /// Body rates and thrust
    BodyRates,
}

/// Layer of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Layer {
    /// Depth, 16 bits, millimetres; 0 means no return
    Depth,
    /// Colour, 8 bits per channel
    Rgb,
}

/// A course, and the view that renders it.
struct Place {
    rules: Rules,
    view: Option<View>,
}

/// An episode, and the index of its course.
struct Env {
    place: usize,
    episode: Episode,
}

/// Runs `vizflyt gym`.
pub fn run(args: &GymArgs) -> Result<ExitCode> {
    ensure!(
        TICKS_HZ.is_multiple_of(args.rate),
        "--rate {}: give a rate that 400 Hz is a multiple of: 10, 20, 25, 40, 50, 80, 100, 200 or 400",
        args.rate
    );
    ensure!((0.1..=3600.0).contains(&args.seconds), "--seconds {}: give 0.1 to 3600", args.seconds);
    let manner = Manner {
        action: match args.action {
            Action::Velocity => ActionKind::Velocity,
            Action::Acceleration => ActionKind::Acceleration,
            Action::BodyRates => ActionKind::BodyRates,
        },
        ticks: TICKS_HZ / args.rate,
        delay: args.delay as usize,
        seconds: args.seconds,
    };
    let project = CourseProject::find(&args.project)?;
    let mut places = places(args, &project)?;
    let mut envs: Vec<Env> = (0..args.envs as usize)
        .map(|index| {
            let place = index % places.len();
            Env { place, episode: Episode::start(&places[place].rules, &manner, 0) }
        })
        .collect();
    let image = places[0].view.as_ref().map(View::size);
    let [depth, rgb] =
        [Layer::Depth, Layer::Rgb].map(|layer| image.is_some() && args.layers.contains(&layer));
    let mut out = BufWriter::new(io::stdout().lock());
    let arena = &places[0].rules.arena;
    let head = json!({
        "version": 1, "envs": envs.len(), "action": ACTION, "state": STATE, "figures": FIGURES,
        "image": image, "depth": depth, "rgb": rgb, "courses": places.len(), "project": project.name(),
        "max_speed_mps": arena.limits.max_speed_mps, "max_acceleration_mps2": arena.limits.max_acceleration_mps2,
        "rate_hz": args.rate, "stages": arena.stages.len(),
    });
    writeln!(out, "{head}")?;
    out.flush()?;
    let mut input = io::stdin().lock();
    let mut order = Order::for_envs(envs.len());
    while order.read(&mut input)? {
        envs.par_iter_mut().zip(&order.resets).zip(&order.seeds).zip(&order.actions).for_each(
            |(((env, reset), seed), action)| {
                if *reset {
                    env.place = (*seed % places.len() as u64) as usize;
                    env.episode = Episode::start(&places[env.place].rules, &manner, *seed);
                } else {
                    env.episode.step(&places[env.place].rules, &manner, *action);
                }
            },
        );
        answer(&mut out, &envs, &mut places, &manner, Drawn { depth, rgb })?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Creates the courses, on all cores.
fn places(args: &GymArgs, project: &CourseProject) -> Result<Vec<Place>> {
    let limits = airframe_limits();
    let depth_alone = !args.layers.contains(&Layer::Rgb);
    let made: Result<Vec<_>> = args
        .courses
        .par_iter()
        .map(|&seed| {
            let course = CourseInstance::make(project, Level::Ug, args.variant, seed)?;
            let view = args
                .camera
                .map(|size| View::new(&course, size, args.fov, args.error_px, depth_alone))
                .transpose()?;
            Ok(Place { rules: Rules::new(course.arena, course.obstacles, limits), view })
        })
        .collect();
    let made = made?;
    ensure!(!made.is_empty(), "--courses: give at least one seed");
    Ok(made)
}

/// Writes the complete output of a step to Python.
fn answer(
    out: &mut impl Write,
    envs: &[Env],
    places: &mut [Place],
    manner: &Manner,
    drawn: Drawn,
) -> Result<()> {
    let mut bytes = Vec::new();
    let mut state = [0.0; STATE];
    for env in envs {
        env.episode.write_state(&places[env.place].rules, manner, &mut state);
        append(&state, &mut bytes);
    }
    for env in envs {
        append(&env.episode.figures(), &mut bytes);
    }
    bytes.extend(envs.iter().map(|env| env.episode.end() as u8));
    out.write_all(&bytes)?;
    if drawn.depth || drawn.rgb {
        draw::images(out, envs, places, drawn)?;
    }
    out.flush().context("cannot write to Python")
}

/// Input of one step from Python.
struct Order {
    resets: Vec<bool>,
    seeds: Vec<u64>,
    actions: Vec<[f32; ACTION]>,
    bytes: Vec<u8>,
}

impl Order {
    /// Bytes of each environment: reset flag, seed, action.
    const BYTES: usize = 1 + 8 + 4 * ACTION;

    fn for_envs(count: usize) -> Self {
        Self {
            resets: vec![false; count],
            seeds: vec![0; count],
            actions: vec![[0.0; ACTION]; count],
            bytes: vec![0; count * Self::BYTES],
        }
    }

    /// Reads the next input; returns false at the end.
    fn read(&mut self, input: &mut impl Read) -> Result<bool> {
        let mut read = 0;
        while read < self.bytes.len() {
            match input.read(&mut self.bytes[read..]) {
                Ok(0) if read == 0 => return Ok(false),
                Ok(0) => return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
                Ok(more) => read += more,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
        let count = self.resets.len();
        let (resets, rest) = self.bytes.split_at(count);
        let (seeds, actions) = rest.split_at(8 * count);
        for (to, from) in self.resets.iter_mut().zip(resets) {
            *to = *from != 0;
        }
        let (seeds, _) = seeds.as_chunks();
        for (to, from) in self.seeds.iter_mut().zip(seeds) {
            *to = u64::from_le_bytes(*from);
        }
        let (actions, _) = actions.as_chunks();
        for (to, from) in self.actions.as_flattened_mut().iter_mut().zip(actions) {
            *to = f32::from_le_bytes(*from);
        }
        Ok(true)
    }
}
