//! `vizflyt dataset`: renders labelled images of a scene, for training and evaluation.
//!
//! ```text
//! options -> asked (dataset.json): exactly the settings that determine the files
//! for each scene:
//!   world     splats cut into things, gates, free space
//!   shot      pose, light, textures of image N: a function of the seeds and N
//!   render    colour, depth, ids -> layers (labels); one image at a time on each thread
//!   store     files of the layers, then the record, which marks the image as complete
//! after all images: coco | yolo | euroc, from the records
//! ```
//! Therefore, shards (`--shard`), interruptions and the number of threads do not change an image.

mod classes;
mod coco;
mod distractor;
mod euroc;
mod free_space;
mod outline;
mod randomize;
mod record;
mod render;
mod sheet;
mod shot;
mod store;
mod texture;
mod work;
mod world;
mod yolo;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use clap::{ArgGroup, Args};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_scenes::projects::{self, CourseProject};
use vizflyt_server::scene::{BareArgs, PartsFile, scene_file, scene_hash};
use vizflyt_trust::hex;

use self::classes::Classes;
use self::randomize::Randomize;
use self::record::{ImageRecord, ThingRecord};
use self::render::Wanted;
use self::shot::{PathOf, Poses, RandomPoses, Shooting};
use self::store::{Format, Layer, Store};
use self::work::{Plan, SceneSource};
use crate::evaluate::trajectory::{self, Stamped};
use crate::scene::camera::ImageSize;
use crate::shard::Shard;

/// Render labelled images of a scene as a data set
///
/// Layers: colour, depth, normals, masks, optical flow. Annotations: boxes, masks, corners of
/// gates.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt dataset --project p3 --seeds 10 --images 2000 -o windows            COCO, a tenth of the scenes held out
  vizflyt dataset --project p3 --images 500 --format yolo-seg -o windows --things gate
  vizflyt dataset --project p5 --randomize randomize.toml --sheet sheet.jpg -o race
  vizflyt dataset --scene my-room --parts parts.toml --images 300 -o room     parts of a captured scene, named by boxes
  vizflyt dataset --project forest --path flight.tum --format euroc -o along  along a path
  vizflyt dataset --project p3 --images 9000 --shard 1/3 -o part              a third; run again to resume

docs/guides/datasets.md describes all layers and files.")]
#[command(group = ArgGroup::new("world").args(["project", "scene"]).required(true))]
pub struct DatasetArgs {
    #[arg(long, help_heading = "Scene", value_name = "NAME", help = format!(
        "Project of the courses: {}", projects::NAMES.join(", ")
    ))]
    project: Option<String>,
    /// arena.toml, its folder, or a scene file
    #[arg(long, help_heading = "Scene", value_name = "PATH")]
    scene: Option<PathBuf>,
    #[command(flatten)]
    bare: BareArgs,
    /// Seed of the first course, and of all random values
    #[arg(long, help_heading = "Scene", value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Number of courses of --project, with consecutive seeds
    #[arg(long, help_heading = "Scene", value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    seeds: u32,
    /// Parts of the scene, defined by boxes
    #[arg(long, help_heading = "Scene", value_name = "FILE.toml")]
    parts: Option<PathBuf>,
    /// Randomization from image to image
    ///
    /// Light, fog, textures of gates, distractors, vehicles, the camera.
    #[arg(long, help_heading = "Scene", value_name = "FILE.toml")]
    randomize: Option<PathBuf>,
    /// Path with poses: TUM text, EuRoC CSV or a flight's log
    ///
    /// Without it, random poses in the free space are used.
    #[arg(long, help_heading = "Poses", value_name = "FILE")]
    path: Option<String>,
    /// Frame of the poses of --path
    #[arg(long, help_heading = "Poses", value_enum, default_value_t, requires = "path")]
    path_of: PathOf,
    /// Minimum distance of random poses from solid space [m]
    #[arg(
        long,
        help_heading = "Poses",
        value_name = "M",
        default_value_t = 0.25,
        conflicts_with = "path"
    )]
    clearance: f64,
    /// Maximum pitch and roll of random poses [deg]
    #[arg(
        long,
        help_heading = "Poses",
        value_name = "DEG",
        default_value_t = 15.0,
        conflicts_with = "path"
    )]
    tilt: f64,
    /// Probability that a random pose looks towards a gate
    #[arg(
        long,
        help_heading = "Poses",
        value_name = "P",
        default_value_t = 0.7,
        conflicts_with = "path"
    )]
    look_at_gate: f64,
    /// Range of distances from that gate [m]
    #[arg(long, help_heading = "Poses", value_name = "LEAST..MOST", default_value = "0.8..5", value_parser = bounds, conflicts_with = "path")]
    gate_distance: [f64; 2],
    /// Number of images over all courses [default: 100, or all of --path]
    #[arg(long, help_heading = "Images", value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    images: Option<u64>,
    /// Image size
    #[arg(long, help_heading = "Images", value_name = "WxH", default_value = "320x240")]
    size: ImageSize,
    /// Horizontal field of view [deg]
    #[arg(long, help_heading = "Images", value_name = "DEG", default_value_t = 90.0)]
    fov: f64,
    /// Layers to write for each image
    #[arg(
        long,
        help_heading = "Images",
        value_enum,
        value_delimiter = ',',
        default_value = "rgb,depth,normals,instances,classes,flow"
    )]
    layers: Vec<Layer>,
    /// Time between the two images of optical flow, for random poses [s]
    #[arg(
        long,
        help_heading = "Images",
        value_name = "S",
        default_value_t = 0.04,
        conflicts_with = "path"
    )]
    flow_dt: f64,
    /// JPEG quality of the colour images [default: PNG]
    #[arg(long, help_heading = "Images", value_name = "QUALITY", value_parser = clap::value_parser!(u8).range(1..=100))]
    jpeg: Option<u8>,
    /// Layout of the data set
    #[arg(long, help_heading = "Annotations", value_enum, default_value_t = Format::Coco)]
    format: Format,
    /// Annotated classes [default: all classes of things]
    #[arg(long, help_heading = "Annotations", value_name = "CLASS", value_delimiter = ',')]
    things: Vec<String>,
    /// Minimum size of annotated things [px]
    #[arg(long, help_heading = "Annotations", value_name = "PX", default_value_t = 12)]
    min_area: u32,
    /// Held-out share of the images; complete courses if there are several
    #[arg(long, help_heading = "Annotations", value_name = "SHARE", default_value_t = 0.1)]
    val: f64,
    /// Output folder; an interrupted data set is resumed
    #[arg(short, long, help_heading = "Output", value_name = "DIR")]
    output: PathBuf,
    /// PNG or JPEG with a few images and all of their layers
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    sheet: Option<PathBuf>,
    /// Render only shard I of N, as 2/4
    ///
    /// The last shard to finish, or a run without this option, writes the annotations.
    #[arg(long, help_heading = "Output", value_name = "I/N")]
    shard: Option<Shard>,
    /// Number of threads [default: one per core]
    #[arg(long, help_heading = "Output", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
}

/// Runs `vizflyt dataset`.
pub fn run(args: &DatasetArgs) -> Result<ExitCode> {
    let plan = plan(args)?;
    let store = Store::open(&args.output, args.format, args.jpeg.is_some(), &plan.asked)?;
    let rendered = work::render_all(&plan, &store)?;
    if rendered.images > 0 {
        print_fmt!(
            "rendered    {} images in {:.1} s: {:.0} a second, {:.0} a second of processor",
            rendered.images,
            rendered.seconds,
            rendered.images as f64 / rendered.seconds,
            rendered.images as f64 / rendered.processor_seconds
        );
    }
    let missing = (0..plan.images).filter(|&index| !plan.is_there(&store, index)).count();
    if missing > 0 {
        print_fmt!("missing     {missing} of {} images; run the other shards", plan.images);
    } else {
        write_annotations(&plan, &store, args.format)?;
        print_fmt!("complete    {} images in {}", plan.images, args.output.display());
    }
    if let Some(path) = &args.sheet {
        work::write_sheet(&plan, path)?;
        print_fmt!("sheet       {}", path.display());
    }
    Ok(ExitCode::SUCCESS)
}

fn write_annotations(plan: &Plan, store: &Store, format: Format) -> Result<()> {
    let labelled = Labelled { plan, things: plan.things.clone() };
    match format {
        Format::Coco => {
            plan.splits().iter().try_for_each(|split| coco::write(store, &labelled, split))
        }
        Format::Euroc => euroc::write(store, &labelled, &plan.layers),
        _ => yolo::write(store, &labelled, format, &plan.splits()),
    }
}

/// Input of the writers of annotations.
struct Labelled<'a> {
    plan: &'a Plan,
    /// Annotated classes, in order of their numbers.
    things: Vec<String>,
}

impl Labelled<'_> {
    /// Reads the records of a split, in order.
    fn records(&self, store: &Store, split: &str) -> impl Iterator<Item = Result<ImageRecord>> {
        let of_split = (0..self.plan.images).filter(move |&index| self.plan.split(index) == split);
        of_split.map(move |index| self.plan.with_name(index, |name| store.read(name)))
    }

    /// Returns the annotated things of an image, with the indices of their classes.
    fn annotated<'r>(
        &self,
        record: &'r ImageRecord,
    ) -> impl Iterator<Item = (usize, &'r ThingRecord)> {
        let large = record.things.iter().filter(|thing| thing.area_px >= self.plan.min_area_px);
        large.filter_map(|thing| {
            let class = self.things.iter().position(|name| *name == thing.class)?;
            Some((class, thing))
        })
    }
}

/// Checks the options and returns the plan.
fn plan(args: &DatasetArgs) -> Result<Plan> {
    let randomize = args.randomize.as_deref().map(Randomize::read).transpose()?.unwrap_or_default();
    let parts = args.parts.as_deref().map(PartsFile::read).transpose()?.unwrap_or_default();
    let classes = Classes::with(parts.parts.iter().map(|part| &*part.class))?;
    let source = source(args)?;
    ensure!((10.0..=150.0).contains(&args.fov), "--fov {}: give 10 to 150 degrees", args.fov);
    ensure!((0.0..=0.9).contains(&args.val), "--val {}: give a share from 0 to 0.9", args.val);
    let ImageSize { width_px, height_px } = args.size;
    let sides = 16..=4096;
    ensure!(
        sides.contains(&width_px) && sides.contains(&height_px),
        "--size {width_px}x{height_px}: give sides of 16 to 4096 px"
    );
    ensure!(args.layers.contains(&Layer::Rgb), "--layers must include rgb");
    let poses = poses(args)?;
    let images = match (&poses, args.images) {
        (Poses::Random(_), images) => images.unwrap_or(100),
        (Poses::Path { poses, .. }, images) => {
            let most = poses.len() as u64 * u64::from(args.seeds);
            let images = images.unwrap_or(most);
            ensure!(
                images <= most,
                "--images {images}: the path has {most} poses over all courses"
            );
            images
        }
    };
    ensure!(
        images >= u64::from(args.seeds),
        "--images {images}: {} courses need one each; give more, or fewer --seeds",
        args.seeds
    );
    let things: Vec<String> = if args.things.is_empty() {
        classes.things().map(str::to_owned).collect()
    } else {
        args.things.clone()
    };
    for name in &things {
        ensure!(
            classes.things().any(|known| known == name),
            "--things {name}: unknown class of things; there are {}",
            classes.things().collect::<Vec<_>>().join(", ")
        );
    }
    let intrinsics = Intrinsics::from_horizontal_fov(width_px, height_px, args.fov.to_radians());
    let shooting = Shooting { seed: args.seed, intrinsics, poses, randomize };
    let asked = asked(args, &source, &shooting, images, &parts, &things)?;
    let has = |layer| args.layers.contains(&layer);
    Ok(Plan {
        asked,
        source,
        parts,
        shooting,
        classes,
        things,
        min_area_px: args.min_area,
        seeds: args.seeds,
        images,
        val: if args.format == Format::Euroc { 0.0 } else { args.val },
        layers: args.layers.clone(),
        wanted: Wanted {
            next: has(Layer::Next),
            normals: has(Layer::Normals),
            classes: has(Layer::Classes),
            flow: has(Layer::Flow),
        },
        jpeg: args.jpeg,
        shard: args.shard,
        threads: args.threads.map(usize::from),
    })
}

fn source(args: &DatasetArgs) -> Result<SceneSource> {
    if let Some(name) = &args.project {
        return Ok(SceneSource::Project(Box::new(CourseProject::named(name)?)));
    }
    let path = args.scene.clone().context("give --project or --scene")?;
    ensure!(args.seeds == 1, "--seeds is for --project; --scene has only one scene");
    Ok(SceneSource::Scene(path, args.bare))
}

fn poses(args: &DatasetArgs) -> Result<Poses> {
    if let Some(path) = &args.path {
        return Ok(Poses::Path { poses: trajectory::read(path)?, of: args.path_of });
    }
    ensure!(
        (0.05..=2.0).contains(&args.clearance),
        "--clearance {}: give 0.05 to 2 m",
        args.clearance
    );
    ensure!((0.0..=60.0).contains(&args.tilt), "--tilt {}: give 0 to 60 degrees", args.tilt);
    ensure!(
        (0.0..=1.0).contains(&args.look_at_gate),
        "--look-at-gate {}: give a probability from 0 to 1",
        args.look_at_gate
    );
    ensure!((1e-3..=1.0).contains(&args.flow_dt), "--flow-dt {}: give 0.001 to 1 s", args.flow_dt);
    Ok(Poses::Random(RandomPoses {
        clearance_m: args.clearance,
        tilt_deg: args.tilt,
        look_at_gate: args.look_at_gate,
        gate_distance_m: args.gate_distance,
        flow_dt_s: args.flow_dt,
    }))
}

/// Returns all settings that determine the files of the data set, for `dataset.json`.
fn asked(
    args: &DatasetArgs,
    source: &SceneSource,
    shooting: &Shooting,
    images: u64,
    parts: &PartsFile,
    things: &[String],
) -> Result<Value> {
    let scene = match source {
        SceneSource::Project(project) => json!({"project": project.name()}),
        SceneSource::Scene(path, bare) => {
            let file = scene_file(path)?;
            let hash =
                scene_hash(&file).with_context(|| format!("cannot read {}", file.display()))?;
            let arena = [path.clone(), path.join("arena.toml")]
                .iter()
                .find(|path| {
                    path.extension().is_some_and(|ending| ending == "toml") && path.is_file()
                })
                .map(std::fs::read)
                .transpose()
                .with_context(|| format!("cannot read {}", path.display()))?;
            let arena = arena.map(|text| hex(&Sha256::digest(text)));
            json!({"sha256": hex(&hash), "arena_sha256": arena, "up": bare.up.map(|up| format!("{up:?}")), "scale": bare.scale})
        }
    };
    let poses = match &shooting.poses {
        Poses::Random(bounds) => json!({"random": bounds}),
        Poses::Path { poses, of } => {
            let number = |pose: &Stamped| {
                let Stamped { at_s, position_m, rotation } = pose;
                [&[*at_s][..], &position_m.to_array(), &rotation.to_array()].concat()
            };
            let bytes: Vec<u8> = poses.iter().flat_map(number).flat_map(f64::to_le_bytes).collect();
            json!({"path_sha256": hex(&Sha256::digest(bytes)), "of": of})
        }
    };
    let ImageSize { width_px, height_px } = args.size;
    Ok(json!({
        "vizflyt": env!("CARGO_PKG_VERSION"),
        "scene": scene,
        "seed": args.seed,
        "seeds": args.seeds,
        "images": images,
        "size_px": [width_px, height_px],
        "fov_deg": args.fov,
        "format": args.format,
        "layers": args.layers,
        "jpeg": args.jpeg,
        "things": things,
        "min_area_px": args.min_area,
        "val": args.val,
        "poses": poses,
        "randomize": shooting.randomize,
        "parts": parts.parts,
        "classes": Classes::with(parts.parts.iter().map(|part| &*part.class))?.names(),
    }))
}

/// Parses `0.8..5`.
fn bounds(text: &str) -> Result<[f64; 2], String> {
    let ends = text.split_once("..").and_then(|(a, b)| Some([a.parse().ok()?, b.parse().ok()?]));
    match ends {
        Some([least, most]) if 0.1 <= least && least <= most && most <= 100.0 => Ok([least, most]),
        _ => Err(format!("'{text}' is not a range within 0.1 to 100 m; write it as 0.8..5")),
    }
}
