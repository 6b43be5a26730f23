//! `vizflyt bench render`: render time of this machine.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Result, bail};
use clap::Args;
use glam::DVec3;
use serde::Serialize;
use vizflyt_process::print_fmt;
use vizflyt_process::processor_seconds;
use vizflyt_scenes::Variant;
use vizflyt_server::render::environment::{atmosphere, weather};
use vizflyt_server::render::{DetailKind, RendererKind, choose, open_packed};
use vizflyt_server::scene::load_as_it_is;
use vizflyt_splat::weather::{Moment, WeatherPass};
use vizflyt_splat::{
    Camera, Chosen, CpuRenderer, Loading, Need, PackedScene, PassTimes, Rasterizer, RgbdImage,
    Scene,
};
use vizflyt_studio::scene::MEMORY_MIB;
use vizflyt_studio::scene::camera::{self, ImageSize};

/// Measure the time to render an image, in total and per pass
#[derive(Args, Debug)]
#[command(after_help = "Each image has RGB, alpha, and expected and median depth. With several \
cameras, each renders --images images, in turn; the results are over all images.

Examples:
  vizflyt bench render room.ply --camera cam.json
  vizflyt bench render room.ply --camera a.json --camera b.json --size 640x480 --json
  vizflyt bench render forest/arena.toml --camera cam.json --renderer cpu --images 200
  vizflyt bench render room.ply --camera cam.json --limits
  vizflyt bench render forest/arena.toml --camera cam.json --environment rain")]
pub(super) struct RenderArgs {
    /// Scene file, packed scene (`scene pack`), or arena.toml (then its scene)
    scene: PathBuf,
    /// Also render in this light and weather, and print the ratio
    #[arg(long, help_heading = "Scene", value_name = "NAME", long_help = format!(
        "Also render each image in this light and weather, alternating with a clear one, and print the ratio: {}",
        Variant::names()
    ))]
    environment: Option<Variant>,
    /// Camera, as for `vizflyt scene render`; can be repeated
    #[arg(long = "camera", help_heading = "Rendering", value_name = "CAM.json", required = true)]
    cameras: Vec<PathBuf>,
    /// Image size instead of the camera's; the field of view stays the same
    #[arg(long, help_heading = "Rendering", value_name = "WxH")]
    size: Option<ImageSize>,
    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Level of detail for large scenes
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    detail: DetailKind,
    /// Memory for the blocks of a packed scene [MiB]
    ///
    /// Measured images do not wait for blocks.
    #[arg(long, help_heading = "Rendering", value_name = "MIB", default_value_t = MEMORY_MIB, value_parser = clap::value_parser!(u32).range(1..))]
    memory: u32,
    /// Measured images per camera, after a warm-up
    #[arg(long, help_heading = "Measurement", value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    images: u32,
    /// Also measure the limits of this processor, and compare each pass with them
    ///
    /// Prints the minimum time of each pass: the time for the pixels of its splats if all lanes of
    /// the vector units are used, or the time to transfer its bytes.
    #[arg(long, help_heading = "Measurement", conflicts_with = "environment")]
    limits: bool,
    /// Print one JSON object
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Output of `--json`. Times are medians in milliseconds, unless the name states another statistic.
#[derive(Debug, Serialize)]
struct Figures {
    scene: String,
    splats: usize,
    width_px: u32,
    height_px: u32,
    cameras: usize,
    images: usize,
    renderer: String,
    renderer_reason: String,
    prepare_ms: f64,
    least_ms: f32,
    median_ms: f32,
    p99_ms: f32,
    /// Processor time (user and system, all threads) of one image: the cost if other programs use
    /// the processors.
    processor_ms: f64,
    passes: Passes,
    #[serde(skip_serializing_if = "Option::is_none")]
    limits: Option<Limits>,
    /// Results with light and weather, if requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    environment: Option<EnvironmentFigures>,
    /// Workload of the renderer for one image: mean over the last image of each camera.
    workload: Work,
}

/// Cost of light and weather: the same images with and without an environment.
#[derive(Debug, Serialize)]
struct EnvironmentFigures {
    name: String,
    /// Time of a whole image.
    median_ms: f32,
    /// Time of the effects that are applied to the finished image.
    effects_median_ms: f32,
    /// Median ratio of the time of an image to that of the clear image before it.
    ratio: f32,
}

/// Minimum time of each pass on this machine, and the values from which it is calculated.
#[derive(Debug, Serialize)]
struct Limits {
    bound_ms: f32,
    bound_passes: Passes,
    /// All threads together. [10^9 operations/s]
    vector_operations_g: f64,
    lanes: usize,
    bytes_g: f64,
    /// (Pixel, splat) pairs of an image, mean over the cameras.
    evaluations: u64,
    /// Fraction of the vector lanes in blending that evaluate such a pair.
    lanes_used: f64,
    /// Fraction of the (tile, splat) pairs that come before the end of their tile's last pixel.
    pairs_used: f64,
}

#[derive(Debug, Serialize)]
struct Passes {
    cull_ms: f32,
    project_ms: f32,
    sort_ms: f32,
    bin_ms: f32,
    blend_ms: f32,
    read_ms: f32,
}

impl Passes {
    /// Returns the passes in the order of execution.
    fn named(&self) -> [(&'static str, f32); 6] {
        [
            ("cull", self.cull_ms),
            ("project", self.project_ms),
            ("sort", self.sort_ms),
            ("bin", self.bin_ms),
            ("blend", self.blend_ms),
            ("read", self.read_ms),
        ]
    }
}

#[derive(Debug, Default, Serialize)]
struct Work {
    splats: usize,
    visible: usize,
    pairs: usize,
}

/// Runs `vizflyt bench render`.
pub(super) fn run(args: &RenderArgs) -> Result<()> {
    let figures = measure(args)?;
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&figures)?);
    } else {
        print(&figures);
    }
    Ok(())
}

fn measure(args: &RenderArgs) -> Result<Figures> {
    if args.limits && args.renderer == RendererKind::Gpu {
        bail!("--limits measures the processor; omit --renderer");
    }
    let cameras: Vec<Camera> = args
        .cameras
        .iter()
        .map(|path| {
            let camera = camera::read(path)?;
            args.size.map_or(Ok(camera), |size| camera::resized(&camera, size))
        })
        .collect::<Result<_>>()?;
    let Opened { path, splats, mut renderer, reason, prepare_ms } = opened(args)?;

    let mut images = [RgbdImage::default()];
    let mut times: Vec<PassTimes> = Vec::new();
    let mut processor_ms: Vec<f64> = Vec::new();
    let mut work = Work::default();
    let (mut figures, mut pass) = (Vec::new(), WeatherPass::default());
    let mut needs = Vec::new();
    for camera in &cameras {
        for image in 0..WARM_UP + args.images {
            let before_s = processor_seconds()?;
            let rasterizer = renderer.rasterizer();
            let taken = rasterizer.render(&[], std::slice::from_ref(camera), &mut images)?;
            if image >= WARM_UP {
                times.push(taken);
                processor_ms.push((processor_seconds()? - before_s) * 1e3);
            }
            let Some(variant) = args.environment else { continue };
            let environment = variant.environment();
            let camera = Camera { atmosphere: atmosphere(&environment), ..*camera };
            let start = Instant::now();
            rasterizer.render(&[], &[camera], &mut images)?;
            let rendered_ms = start.elapsed().as_secs_f32() * 1e3;
            pass.apply(&weather(&environment), &camera, &moment(image), &mut images[0]);
            let all_ms = start.elapsed().as_secs_f32() * 1e3;
            if image >= WARM_UP {
                figures.push([all_ms, all_ms - rendered_ms, all_ms / taken.total_ms]);
            }
        }
        if let Renderer::Processor(renderer) = &renderer {
            let k = camera.intrinsics;
            needs.push(renderer.need([k.width_px as usize, k.height_px as usize]));
        }
        let seen = renderer.rasterizer().workload();
        work.splats = seen.splats;
        work.visible += seen.visible / cameras.len();
        work.pairs += seen.pairs / cameras.len();
    }
    let at = |share: f64, of: fn(&PassTimes) -> f32| {
        let mut values: Vec<f32> = times.iter().map(of).collect();
        values.sort_unstable_by(f32::total_cmp);
        values[(share * (values.len() - 1) as f64).round() as usize]
    };
    processor_ms.sort_unstable_by(f64::total_cmp);
    let of_weather = |figure: usize| {
        let mut values: Vec<f32> = figures.iter().map(|each: &[f32; 3]| each[figure]).collect();
        values.sort_unstable_by(f32::total_cmp);
        values[values.len() / 2]
    };
    let environment = args.environment.map(|variant| EnvironmentFigures {
        name: variant.to_string(),
        median_ms: of_weather(0),
        effects_median_ms: of_weather(1),
        ratio: of_weather(2),
    });
    let k = cameras[0].intrinsics;
    Ok(Figures {
        scene: path.display().to_string(),
        splats,
        width_px: k.width_px,
        height_px: k.height_px,
        cameras: cameras.len(),
        images: times.len(),
        renderer: renderer.rasterizer().name().into_owned(),
        renderer_reason: reason,
        prepare_ms,
        least_ms: at(0.0, |t| t.total_ms),
        median_ms: at(0.5, |t| t.total_ms),
        p99_ms: at(0.99, |t| t.total_ms),
        processor_ms: processor_ms[processor_ms.len() / 2],
        passes: Passes {
            cull_ms: at(0.5, |t| t.cull_ms),
            project_ms: at(0.5, |t| t.project_ms),
            sort_ms: at(0.5, |t| t.sort_ms),
            bin_ms: at(0.5, |t| t.bin_ms),
            blend_ms: at(0.5, |t| t.blend_ms),
            read_ms: at(0.5, |t| t.read_ms),
        },
        limits: match &renderer {
            Renderer::Processor(renderer) => Some(limits(renderer, &needs)),
            Renderer::Chosen(_) => None,
        },
        environment,
        workload: work,
    })
}

/// A scene, ready for rendering.
struct Opened {
    path: PathBuf,
    splats: usize,
    renderer: Renderer,
    reason: String,
    prepare_ms: f64,
}

fn opened(args: &RenderArgs) -> Result<Opened> {
    if PackedScene::is_packed(&args.scene) {
        let start = Instant::now();
        let memory_bytes = args.memory as usize * (1 << 20);
        // The warm-up images load the blocks that the measured ones need.
        let renderer = open_packed(&args.scene, &[], args.renderer, memory_bytes, Loading::Whole)?;
        return Ok(Opened {
            path: args.scene.clone(),
            splats: renderer.workload().splats,
            renderer: if args.limits {
                Renderer::Processor(Box::new(renderer))
            } else {
                Renderer::Chosen(Box::new(renderer))
            },
            reason: "a packed scene".to_owned(),
            prepare_ms: start.elapsed().as_secs_f64() * 1e3,
        });
    }
    let (path, loaded) = load_as_it_is(&args.scene)?;
    let start = Instant::now();
    let (renderer, reason) = if args.limits {
        let scene = Scene::from(&loaded.splats);
        let renderer = CpuRenderer::with_detail(scene, args.detail.of(&scene));
        (Renderer::Processor(Box::new(renderer)), "required by --limits".to_owned())
    } else {
        let Chosen { rasterizer, reason } = choose(&loaded.splats, args.renderer, args.detail)?;
        (Renderer::Chosen(rasterizer), reason)
    };
    let prepare_ms = start.elapsed().as_secs_f64() * 1e3;
    Ok(Opened { path, splats: loaded.splats.len(), renderer, reason, prepare_ms })
}

/// Processor renderer, which can measure its limits, or any other.
enum Renderer {
    Processor(Box<CpuRenderer>),
    Chosen(Box<dyn Rasterizer>),
}

impl Renderer {
    fn rasterizer(&mut self) -> &mut dyn Rasterizer {
        match self {
            Self::Processor(renderer) => renderer.as_mut(),
            Self::Chosen(rasterizer) => rasterizer.as_mut(),
        }
    }
}

/// Returns the mean minimum time of the images.
fn limits(renderer: &CpuRenderer, needs: &[Need]) -> Limits {
    let count = needs.len().max(1) as u64;
    // The memory bandwidth is measured over as many bytes as an image uses.
    let sum = |of: fn(&Need) -> u64| needs.iter().map(of).sum::<u64>();
    let share = |part: u64, whole: u64| part as f64 / whole.max(1) as f64;
    let machine = renderer.machine((sum(Need::bytes) / count) as usize);
    let lanes = machine.lanes as u64;
    let bounds: Vec<PassTimes> = needs.iter().map(|need| need.bound(&machine)).collect();
    let mean = |of: fn(&PassTimes) -> f32| bounds.iter().map(of).sum::<f32>() / count as f32;
    Limits {
        bound_ms: mean(|t| t.total_ms),
        bound_passes: Passes {
            cull_ms: mean(|t| t.cull_ms),
            project_ms: mean(|t| t.project_ms),
            sort_ms: mean(|t| t.sort_ms),
            bin_ms: mean(|t| t.bin_ms),
            blend_ms: mean(|t| t.blend_ms),
            read_ms: mean(|t| t.read_ms),
        },
        vector_operations_g: machine.operations_per_s / 1e9,
        lanes: machine.lanes,
        bytes_g: machine.bytes_per_s / 1e9,
        evaluations: sum(|need| need.evaluations) / count,
        lanes_used: share(sum(|need| need.evaluations), sum(|need| need.vectors) * lanes),
        pairs_used: share(sum(|need| need.pairs_used), sum(|need| need.pairs)),
    }
}

/// Returns the time of an image at 30 Hz.
fn moment(image: u32) -> Moment {
    Moment { at_ns: i64::from(image) * 33_333_333, v_world_mps: DVec3::ZERO, seed: 7 }
}

fn print(f: &Figures) {
    print_fmt!("scene       {}: {} splats", f.scene, f.splats);
    print_fmt!("renderer    {} ({})", f.renderer, f.renderer_reason);
    print_fmt!("prepared    in {:.0} ms", f.prepare_ms);
    print_fmt!(
        "images      {} of {}x{} from {} cameras: RGB, alpha, expected and median depth",
        f.images,
        f.width_px,
        f.height_px,
        f.cameras
    );
    print_fmt!(
        "work        {} splats in sight, {} tile pairs",
        f.workload.visible,
        f.workload.pairs
    );
    print_fmt!(
        "median      {:.2} ms, {:.1} images/s; least {:.2} ms",
        f.median_ms,
        1e3 / f.median_ms,
        f.least_ms
    );
    print_fmt!("p99         {:.2} ms", f.p99_ms);
    print_fmt!("processor   {:.2} ms an image, all threads together", f.processor_ms);
    let passes = f.passes.named();
    let bounds = f.limits.as_ref().map(|limits| limits.bound_passes.named());
    for (i, (name, ms)) in passes.into_iter().enumerate() {
        match &bounds {
            Some(bounds) if bounds[i].1 > 0.0 => {
                let bound = bounds[i].1;
                print_fmt!("  {name:<9} {ms:.2} ms, minimum {bound:.2}: {:.1} times", ms / bound);
            }
            _ => print_fmt!("  {name:<9} {ms:.2} ms"),
        }
    }
    if let Some(limits) = &f.limits {
        print_fmt!(
            "minimum     {:.2} ms; the images take {:.1} times as long",
            limits.bound_ms,
            f.median_ms / limits.bound_ms
        );
        print_fmt!(
            "            {:.1} million pixels of splats; the machine does {:.1} billion operations on {} numbers a \
             second, and moves {:.1} GB",
            limits.evaluations as f64 / 1e6,
            limits.vector_operations_g,
            limits.lanes,
            limits.bytes_g
        );
        print_fmt!(
            "            {:.0} % of the vector lanes evaluate such a pixel; {:.0} % of the tile pairs come before \
             their tile's end",
            limits.lanes_used * 1e2,
            limits.pairs_used * 1e2
        );
    }
    if let Some(EnvironmentFigures { name, median_ms, effects_median_ms, ratio }) = &f.environment {
        print_fmt!(
            "{name:<11} {median_ms:.2} ms, of which {effects_median_ms:.2} are weather and lamps"
        );
        print_fmt!("            {ratio:.2} of a clear image, median of pairs");
    }
}

/// Images before the measurement: buffers grow to their size, and clocks reach their speed.
const WARM_UP: u32 = 5;
