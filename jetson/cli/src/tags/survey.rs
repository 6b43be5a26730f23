//! `vizflyt tags survey`: measures the poses of a mat's tags, and of fixed cameras.

use std::io::BufRead as _;
use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use vizflyt_process::print_line;
use vizflyt_tags::camera::{Mounting, Survey, TagCamera};
use vizflyt_tags::capture::{self, ImageSource};
use vizflyt_tags::detect::{Detector, DetectorSettings};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::layout::{LayoutFrame, TagLayout};
use vizflyt_tags::survey::{self, CameraImages, CubeScale, Picker};

/// Survey the tags of a mat, or fixed cameras
#[derive(Args, Debug)]
pub(super) struct SurveyArgs {
    #[command(subcommand)]
    command: SurveyCommand,
}

#[derive(Subcommand, Debug)]
enum SurveyCommand {
    Mat(MatArgs),
    Cameras(CamerasArgs),
}

/// Measure the pose of each tag of a mat, with one calibrated camera
#[derive(Args, Debug)]
#[command(after_help = "Carry the camera slowly, 0.5 to 1 m above the mat, along and across it,
sometimes tilted. Every image must show at least two tags. A video of one minute is enough.")]
struct MatArgs {
    /// Source of images: a folder, a video file, or as for `tags calibrate`
    source: String,
    /// Camera file from `vizflyt tags calibrate`
    #[arg(long, value_name = "FILE.toml")]
    camera: PathBuf,
    /// Layout of the mat from `vizflyt tags print mat`
    #[arg(long, value_name = "FILE.toml")]
    layout: PathBuf,
    /// Surveyed layout to write
    #[arg(short, long, value_name = "FILE.toml")]
    output: PathBuf,
    /// Tag that defines the frame of the room, at its pose in the layout
    ///
    /// Without this option, the frame is the best fit of all tags.
    #[arg(long, value_name = "ID")]
    anchor: Option<u32>,
    /// Edge of the black squares of tags outside the layout, to survey them too [mm]
    #[arg(long, value_name = "MM")]
    others_mm: Option<f64>,
    /// Duration of the recording from a live camera [s]
    #[arg(long, value_name = "S", default_value_t = 60.0)]
    seconds: f64,
}

/// Measure the poses of fixed cameras from a surveyed mat or a carried cube
///
/// Cameras that do not see the mat need the cube, carried where several cameras see it. Writes the
/// poses into the camera files.
#[derive(Args, Debug)]
#[command(
    after_help = "Live cameras: hold the cube still, press Enter, carry it on; ten places all
over the room are enough. Folders: images with the same number belong together."
)]
struct CamerasArgs {
    /// Camera files; FILE.toml=SOURCE selects another source of images
    #[arg(required = true, value_name = "FILE.toml[=SOURCE]")]
    cameras: Vec<String>,
    /// Surveyed layout of the mat
    #[arg(long, value_name = "FILE.toml")]
    mat: PathBuf,
    /// Layout of the cube, for cameras that do not see the mat
    #[arg(long, value_name = "FILE.toml")]
    cube: Option<PathBuf>,
}

/// Runs `vizflyt tags survey`.
pub(super) fn run(args: &SurveyArgs) -> Result<()> {
    match &args.command {
        SurveyCommand::Mat(args) => mat(args),
        SurveyCommand::Cameras(args) => cameras(args),
    }
}

fn mat(args: &MatArgs) -> Result<()> {
    let camera = TagCamera::read(&args.camera)?;
    let printed = read_layout(&args.layout, LayoutFrame::World)?;
    let family = printed.tags.first().map_or(TagFamily::default(), |tag| tag.family);
    let others = match args.others_mm {
        Some(mm) if (2.0..=5000.0).contains(&mm) => Some((family, mm / 1000.0)),
        Some(mm) => bail!("--others-mm {mm}: give 2 to 5000 mm"),
        None => None,
    };
    let mut detector = detector(&[&printed]);
    let mut source = capture::open(&args.source)?;
    let mut picker = Picker::default();
    let mut first_ns = None;
    while let Some(exposure) = source.next()? {
        check_size(&camera, &exposure.image, &args.source)?;
        picker
            .offer(detector.search(&exposure.image, &camera.intrinsics, true), &camera.intrinsics);
        let first_ns = *first_ns.get_or_insert(exposure.stamp_ns);
        let seconds = exposure.stamp_ns.saturating_sub(first_ns) as f64 / 1e9;
        if picker.is_full() || (source.is_live() && seconds > args.seconds) {
            break;
        }
    }
    let anchor = args.anchor.map(|id| (family, id));
    let found = survey::mat(&camera.intrinsics, &printed, others, anchor, picker.images())?;
    print_line("tag   images  residual mm  sigma mm  moved mm");
    for (tag, known) in found.layout.tags.iter().zip(&found.residuals) {
        let moved = known.moved_m.map_or("new".into(), |m| format!("{:.1}", 1e3 * m));
        print_line(format_args!(
            "{:<5} {:>6}  {:>11.2}  {:>8.2}  {moved:>8}",
            tag.id,
            known.images,
            1e3 * known.rms_m,
            1e3 * known.sigma_m
        ));
    }
    for (family, id, why) in &found.left_out {
        print_line(format_args!("left out: {family} {id}, {why}"));
    }
    print_line(format_args!(
        "{} tags from {} images: corners are {:.2} px off, {:.2} mm on the tags",
        found.layout.tags.len(),
        found.images,
        found.rms_px,
        1e3 * found.rms_m
    ));
    found.layout.write(&args.output)?;
    print_line(format_args!("{}: written", args.output.display()));
    Ok(())
}

fn cameras(args: &CamerasArgs) -> Result<()> {
    let mat = read_layout(&args.mat, LayoutFrame::World)?;
    let cube = args.cube.as_deref().map(|path| read_layout(path, LayoutFrame::Body)).transpose()?;
    let layouts: Vec<&TagLayout> = std::iter::once(&mat).chain(cube.as_ref()).collect();
    let mut detector = detector(&layouts);
    let mut files = Vec::new();
    let mut sources = Vec::new();
    for given in &args.cameras {
        let (path, source) = match given.split_once('=') {
            Some((path, source)) => (PathBuf::from(path), Some(source.to_owned())),
            None => (PathBuf::from(given), None),
        };
        let camera = TagCamera::read(&path)?;
        let Some(source) = source.or_else(|| camera.source.clone()) else {
            bail!("{}: no source in the file; give {}=SOURCE", path.display(), path.display());
        };
        sources.push(capture::open(&source)?);
        files.push((path, source, camera));
    }
    let mut seen: Vec<CameraImages> = files
        .iter()
        .map(|(_, _, camera)| CameraImages {
            name: camera.name.clone(),
            intrinsics: camera.intrinsics,
            images: Vec::new(),
        })
        .collect();
    let is_live = sources.iter().all(|source| source.is_live());
    let mut lines = std::io::stdin().lock().lines();
    loop {
        if is_live && cube.is_some() {
            let count = seen[0].images.len();
            print_line(format_args!(
                "{count} places; hold the cube still and press Enter, or q and Enter to end"
            ));
            match lines.next().transpose()? {
                Some(line) if line.trim() != "q" => {}
                _ => break,
            }
        } else if is_live && seen[0].images.len() >= STILLS {
            break;
        }
        let mut ended = false;
        for ((source, (_, name, camera)), seen) in sources.iter_mut().zip(&files).zip(&mut seen) {
            match newest(source.as_mut(), is_live)? {
                Some(image) => {
                    check_size(camera, &image, name)?;
                    seen.images.push(detector.search(&image, &camera.intrinsics, true));
                }
                None => ended = true,
            }
        }
        if ended {
            break;
        }
    }
    let surveyed = survey::cameras(&seen, &mat, cube.as_ref())?;
    for ((path, _, camera), placed) in files.iter().zip(surveyed.cameras) {
        let survey = Survey {
            sigma_m: placed.sigma_m,
            rms_px: placed.rms_px,
            corners: placed.corners as u32,
        };
        let file = TagCamera {
            mounting: Mounting::World(placed.world_from_cam),
            survey: Some(survey),
            ..camera.clone()
        };
        file.write(path)?;
        let p = placed.world_from_cam.translation_m;
        print_line(format_args!(
            "{}: at {:.3}, {:.3}, {:.3} m +- {:.1} mm; {} corners, {:.2} px off; written to {}",
            camera.name,
            p.x,
            p.y,
            p.z,
            1e3 * placed.sigma_m,
            placed.corners,
            placed.rms_px,
            path.display()
        ));
    }
    if let Some(scale) = surveyed.cube {
        print_line(cube_size(scale));
    }
    Ok(())
}

/// Returns the estimated size of the cube, and what to do.
fn cube_size(CubeScale { scale, sigma }: CubeScale) -> String {
    let (percent, give_or_take) = (1e2 * scale, 1e2 * sigma);
    if !(sigma < UNKNOWN_SCALE) {
        "cube: its size cannot be estimated from these images, as no two cameras see the mat: measure its tags with a \
         ruler, or put the mat where two cameras see it"
            .into()
    } else if (scale - 1.0).abs() > (4.0 * sigma).max(WRONG_SCALE) {
        format!(
            "cube: it has {percent:.1} +- {give_or_take:.1} % of its layout's size; the survey uses this size. \
             Print it \
             again at 100 %, or its layout with --bar-mm {percent:.1}"
        )
    } else {
        format!("cube: {percent:.2} +- {give_or_take:.2} % of its layout's size")
    }
}

/// Returns the next image; of a live camera the newest, without those in the driver's buffer.
fn newest(
    source: &mut dyn ImageSource,
    is_live: bool,
) -> Result<Option<vizflyt_tags::image::Gray>> {
    let mut last = None;
    for _ in 0..if is_live { STALE + 1 } else { 1 } {
        match source.next()? {
            Some(exposure) => last = Some(exposure.image),
            None => return Ok(None),
        }
    }
    Ok(last)
}

fn read_layout(path: &std::path::Path, frame: LayoutFrame) -> Result<TagLayout> {
    let layout = TagLayout::read(path)?;
    if layout.frame != frame {
        let (is, wanted) = match frame {
            LayoutFrame::World => {
                ("on the vehicle (body)", "one in the room, as print mat writes it")
            }
            LayoutFrame::Body => {
                ("in the room (world)", "one on the vehicle, as print cube writes it")
            }
        };
        bail!("{}: its tags are {is}; give {wanted}", path.display());
    }
    Ok(layout)
}

fn detector(layouts: &[&TagLayout]) -> Detector {
    let mut families: Vec<TagFamily> =
        layouts.iter().flat_map(|layout| layout.tags.iter().map(|tag| tag.family)).collect();
    families.sort_unstable();
    families.dedup();
    Detector::new(&families, DetectorSettings::default())
}

fn check_size(camera: &TagCamera, image: &vizflyt_tags::image::Gray, source: &str) -> Result<()> {
    let k = &camera.intrinsics;
    if (image.width_px(), image.height_px()) != (k.width_px, k.height_px) {
        bail!(
            "{source}: images of {}x{}, but camera {:?} was calibrated at {}x{}; a calibration is valid \
             for one size",
            image.width_px(),
            image.height_px(),
            camera.name,
            k.width_px,
            k.height_px
        );
    }
    Ok(())
}

/// Maximum uncertainty of an estimated size.
const UNKNOWN_SCALE: f64 = 0.02;
/// Maximum deviation of the size that is due to printers and scissors.
const WRONG_SCALE: f64 = 0.004;
/// Number of images in the driver's buffer.
const STALE: usize = 4;
/// Number of images of a mat that does not move: averages the noise.
const STILLS: usize = 20;
