//! `vizflyt scene capture`: makes a flyable twin from a video or photos of a room.
//!
//! ```text
//! images   select the sharpest pictures of the video              -> pictures
//! tags     detect printed tags                                    -> pictures of the same place, pairs to compare
//! poses    COLMAP or pycolmap, whichever is installed             -> models of unknown scale and orientation
//! metric   bundle adjustment with tags, verdict                   -> poses in metres, or advice what to film again
//! train    train the splats, with held-out photos                 -> scene.ply
//! finish   carve by the capture's rays; write fence and start     -> scene.ply, arena.toml
//! ```
//! Each stage stores its result in `stages/` (`work.rs`). `capture.json` and `report.html` are always written at the
//! end, also after an error.

mod coverage;
mod finish;
mod images;
mod lens;
mod metric;
mod page;
mod poses;
mod prints;
mod record;
mod training;
mod unseen;
mod work;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use clap::Args;
use sha2::{Digest, Sha256};
use vizflyt_process::print_fmt;
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::layout::TagLayout;
use vizflyt_trust::hex;

use self::images::{Choice, Source};
use self::metric::{Length, Room, Track};
use self::record::{Failure, Record};
use self::training::Schedule;
use self::work::{Fingerprint, Stage, Work};
use crate::scene::align::ClockArgs;

/// Make a flyable twin from a video or photos of a room
#[derive(Args, Debug)]
#[command(after_help = "Files in the output folder:
  scene.ply      twin, in metres, z up; scene.ply.seen has the space that photos saw, the rest is solid
  arena.toml     fence around the seen space, start on the walk; only if the capture is accepted
  report.html    map of the walk, findings, photos next to their renderings
  capture.json   the same for programs: scale and its uncertainty, residuals, times
  stages/        results of the stages; a stage with unchanged inputs is not run again

Videos require the program ffmpeg. Camera poses are estimated by COLMAP: `pip install pycolmap`, or the program
colmap. Put up printed tags before you film: they define the scale, and distinguish places that look alike.

Examples:
  vizflyt scene capture hall.mp4 -o my-hall --tags hall.tags.toml
  vizflyt scene capture hall.mp4 -o my-hall --tag-size 0.2 --camera phone.toml
  vizflyt scene capture hall.mp4 -o my-hall --length 3,8=4.52
  vizflyt scene capture hall.mp4 -o my-hall --track phone.csv --tracked-at 0.03,-0.09,0
  vizflyt scene capture my-photos -o my-hall --poses my-colmap --tags hall.tags.toml
  vizflyt scene capture hall.mp4 -o my-hall --tags hall.tags.toml --from train --steps 7000 --width 640
  vizflyt demo --scene my-hall")]
pub(crate) struct CaptureArgs {
    /// Video, or folder of photos of one camera
    input: PathBuf,
    /// Number of pictures from a video [default: 3 per second, from 80 to 300]
    #[arg(long, help_heading = "Photos", value_name = "N", value_parser = clap::value_parser!(u16).range(8..=2000))]
    frames: Option<u16>,
    /// Maximum width of pictures; wider ones of a video are downscaled [px]
    #[arg(long, help_heading = "Photos", value_name = "PX", default_value_t = 1920, value_parser = clap::value_parser!(u32).range(160..=8192))]
    picture_width: u32,
    /// Lens file of `vizflyt tags calibrate` [default: estimated from the pictures]
    #[arg(long, help_heading = "Photos", value_name = "CAMERA")]
    camera: Option<PathBuf>,
    /// Existing poses of the photos in INPUT: a folder of COLMAP
    #[arg(long, help_heading = "Photos", value_name = "DATASET")]
    poses: Option<PathBuf>,
    /// Python interpreter with pycolmap
    #[arg(long, help_heading = "Photos", value_name = "PROGRAM", conflicts_with = "poses")]
    python: Option<PathBuf>,
    /// Surveyed layout of printed tags in the room (`vizflyt tags print`)
    #[arg(long, help_heading = "Scale and frame", value_name = "LAYOUT", conflicts_with_all = ["tag_size", "length"])]
    tags: Option<PathBuf>,
    /// Edge of the black square of all tags, if their positions are unknown [m]
    #[arg(long, help_heading = "Scale and frame", value_name = "METRES", value_parser = metres)]
    tag_size: Option<f64>,
    /// Numbers of two tags, and the distance between their centres [m]
    #[arg(long, help_heading = "Scale and frame", value_name = "A,B=METRES", value_parser = length)]
    length: Option<Length>,
    /// Motion capture track of a marker fixed to the camera during the capture
    ///
    /// Defines scale, vertical axis and frame of the room.
    #[arg(long, help_heading = "Scale and frame", value_name = "CSV", conflicts_with_all = ["tags", "tag_size", "length"])]
    track: Option<PathBuf>,
    #[command(flatten)]
    clocks: ClockArgs,
    /// Number of training steps
    #[arg(long, help_heading = "Training", default_value_t = 3000, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    steps: u32,
    /// Maximum number of splats
    #[arg(long, help_heading = "Training", default_value_t = 60_000, value_name = "N", value_parser = clap::value_parser!(u32).range(1000..=20_000_000))]
    splats: u32,
    /// Width of the pictures for training [px]
    #[arg(long, help_heading = "Training", default_value_t = 320, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    width: u32,
    /// Random seed
    ///
    /// The same pictures, poses and seed give the same twin on the same kind of processor.
    #[arg(long, help_heading = "Training", default_value_t = 1)]
    seed: u64,
    /// Output folder; created if missing, an interrupted capture is resumed
    #[arg(short, long, help_heading = "Output", value_name = "DIR")]
    output: PathBuf,
    /// Re-run from this stage even if its inputs are unchanged
    #[arg(long, help_heading = "Output", value_name = "STAGE")]
    from: Option<Stage>,
    /// Train and write an arena.toml even if the capture is rejected
    #[arg(long, help_heading = "Output")]
    force: bool,
}

/// Runs `vizflyt scene capture`.
pub(crate) fn run(args: &CaptureArgs) -> Result<ExitCode> {
    let source = Source::of(&args.input)?;
    ensure!(
        args.poses.is_none() || matches!(source, Source::Folder(_)),
        "--poses is for photos: give the folder of the pictures instead of the video"
    );
    ensure!(
        !args.clocks.has_times() || matches!(source, Source::Folder(_)),
        "--times and --rate are for photos; a video has its own times"
    );
    let layout = args.tags.as_deref().map(TagLayout::read).transpose()?;
    let mut work = Work::open(&args.output, args.from)?;
    let mut record = Record::new(&args.input);
    let made = check_programs(args, &source, &work)
        .and_then(|()| make(args, &source, layout, &mut work, &mut record));
    record.stages = work.times().to_vec();
    let made = match made {
        Ok(made) => made,
        Err(error) => {
            record.failure = Some(Failure::new(&error, &args.output, &work));
            // The caller prints the error itself in any case.
            match record.write(&args.output, &work) {
                Ok(()) => print_fmt!("report      {}", args.output.join("report.html").display()),
                Err(cause) => print_fmt!("no report   {cause:#}"),
            }
            return Err(error);
        }
    };
    record.write(&args.output, &work)?;
    print_fmt!("report      {}", args.output.join("report.html").display());
    if made {
        print_fmt!("next        vizflyt demo --scene {}", args.output.display());
    }
    Ok(if made { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Checks that ffmpeg and COLMAP are installed before the video is read.
fn check_programs(args: &CaptureArgs, source: &Source, work: &Work) -> Result<()> {
    if let Source::Video(file) = source {
        images::probe(file)?;
    }
    if args.poses.is_none() && !work.has(Stage::Poses) {
        poses::check_installed(args.python.as_deref())?;
    }
    Ok(())
}

/// Runs the stages. Returns whether all of them ran and the result can be flown.
fn make(
    args: &CaptureArgs,
    source: &Source,
    layout: Option<TagLayout>,
    work: &mut Work,
    record: &mut Record,
) -> Result<bool> {
    let choice = Choice { frames: args.frames.map(usize::from), width_px: args.picture_width };
    let prints = match source {
        Source::Video(file) => (Some((Fingerprint::of(file)?, choice)), Vec::new()),
        Source::Folder(photos) => (None, Fingerprint::below(photos)?),
    };
    let pictures =
        work.stage(Stage::Images, &prints, |folder| images::take(source, choice, folder))?;
    let [width, height] = pictures.size_px;
    work.say(&format!("{} pictures of {width} x {height}", pictures.pictures.len()));
    record.remarks = pictures.remarks();
    for remark in &record.remarks {
        print_fmt!("            {remark}");
    }
    record.pictures = Some(pictures.clone());

    let known =
        args.camera.as_deref().map(|file| lens::read(file, pictures.size_px)).transpose()?;
    let mut families: Vec<TagFamily> =
        layout.iter().flat_map(|layout| layout.tags.iter().map(|tag| tag.family)).collect();
    families.sort();
    families.dedup();
    if families.is_empty() {
        families.push(TagFamily::default());
    }
    let lens = known.unwrap_or_else(|| lens::guess(pictures.size_px));
    let seen = work.stage(Stage::Tags, &(&families, &lens_key(&lens)), |_| {
        prints::look(&pictures, &families, &lens)
    })?;
    work.say(&format!("{} tags in {} pictures", seen.tags.len(), seen.with_tags()));

    let given = args.poses.as_deref().map(Fingerprint::below).transpose()?;
    let poses =
        work.stage(Stage::Poses, &(&given, known.is_some()), |folder| match &args.poses {
            Some(dataset) => poses::take_given(dataset),
            None => poses::find(&pictures, &seen, known.as_ref(), args.python.as_deref(), folder),
        })?;
    let placed = poses.models[0].placed;
    let more = match &poses.models[1..] {
        [] => String::new(),
        others => {
            let sizes: Vec<String> = others.iter().map(|model| model.placed.to_string()).collect();
            format!("; other models: {}", sizes.join(", "))
        }
    };
    work.say(&format!("{placed} pictures placed by {}{more}", poses.tool));
    record.poses = Some(poses.clone());

    let room = Room {
        layout,
        tag_size_m: args.tag_size,
        length: args.length,
        track: args.track.as_deref().map(|file| Track::of(file, &args.clocks)).transpose()?,
        lens_is_known: known.is_some(),
    };
    let metric = work.stage(Stage::Metric, &room, |folder| {
        metric::make(&pictures, &seen, &poses, &room, folder)
    })?;
    work.say(&metric.summary());
    for finding in &metric.findings {
        let word = if finding.refused { "REFUSED" } else { "warning" };
        print_fmt!("{word}     {}: {}", finding.what, finding.remedy);
    }
    let fit_to_train = metric.is_fit_to_train();
    let fit_to_fly = metric.fit_to_fly;
    record.metric = Some(metric.clone());
    if !(fit_to_train || args.force && metric.has_model) {
        print_fmt!("stopped     before training: the scene would be wrong, not only its scale");
        remove_arena(&args.output, work)?;
        return Ok(false);
    }

    let schedule = Schedule {
        steps: args.steps,
        splats: args.splats as usize,
        width_px: args.width,
        seed: args.seed,
    };
    let metric_folder = work.folder(Stage::Metric);
    let trained = work.stage(Stage::Train, &schedule, |folder| {
        training::train(&pictures, &metric_folder, schedule, folder)
    })?;
    let quality = trained.held_out.map_or(String::new(), |held_out| {
        format!("; {} held-out photos: {:.1} dB", held_out.photos, held_out.psnr_db)
    });
    work.say(&format!("{} splats in {} steps{quality}", trained.splats, trained.steps));
    record.trained = Some(trained);

    let name = arena_name(&args.output);
    let trained_folder = work.folder(Stage::Train);
    let finished = work.stage(Stage::Finish, &name, |folder| {
        let dataset = training::read(&pictures, &metric_folder, schedule.width_px)?;
        finish::finish(&name, &dataset, &trained_folder, &metric, folder)
    })?;
    work.say(&format!(
        "{} splats carved away, {} left; {:.0} % of the fence was seen",
        finished.carved,
        finished.splats,
        100.0 * finished.seen_share
    ));
    if let Some(largest) = finished.unseen.first() {
        let (low, high) = (largest.min_m, largest.max_m);
        let all_m2: f64 = finished.unseen.iter().map(|area| area.area_m2).sum();
        print_fmt!(
            "unseen      {all_m2:.0} m2 from above, solid for the referee; largest area within {:.1}, {:.1} to {:.1}, {:.1}",
            low.x,
            low.y,
            high.x,
            high.y
        );
    }
    for finding in &finished.findings {
        print_fmt!("warning     {finding}");
    }
    let can_start = finished.findings.is_empty();
    record.finished = Some(finished);
    let files = work.folder(Stage::Finish);
    for name in ["scene.ply", "scene.ply.seen"] {
        copy(&files.join(name), &args.output.join(name))?;
    }
    if fit_to_fly || args.force {
        write_arena(&args.output, work)?;
    } else {
        remove_arena(&args.output, work)?;
        print_fmt!(
            "no arena    only for viewing: vizflyt scene view {}",
            args.output.join("scene.ply").display()
        );
    }
    if fit_to_fly && !can_start {
        let arena = args.output.join("arena.toml");
        print_fmt!(
            "by hand     correct {}, then: vizflyt arena check {}",
            arena.display(),
            args.output.display()
        );
    }
    Ok(fit_to_fly && can_start)
}

/// Copies a file of a stage to the output folder.
fn copy(from: &Path, to: &Path) -> Result<()> {
    std::fs::copy(from, to).with_context(|| format!("cannot write {}", to.display()))?;
    Ok(())
}

/// Writes arena.toml, unless a user has edited the existing one.
fn write_arena(output: &Path, work: &Work) -> Result<()> {
    let (path, made) = (output.join("arena.toml"), work.folder(Stage::Finish).join("arena.toml"));
    if path.exists() && !is_ours(&path, work) {
        print_fmt!(
            "kept        {} was edited and stays as it is; the new one is {}",
            path.display(),
            made.display()
        );
        return Ok(());
    }
    copy(&made, &path)?;
    let mark = work.mark();
    std::fs::write(&mark, digest(&path)).with_context(|| format!("cannot write {}", mark.display()))
}

/// Removes the arena.toml of an earlier run, so that a rejected capture cannot be flown.
fn remove_arena(output: &Path, work: &Work) -> Result<()> {
    let path = output.join("arena.toml");
    if !path.exists() {
        return Ok(());
    }
    if is_ours(&path, work) {
        return std::fs::remove_file(&path)
            .with_context(|| format!("cannot remove {}", path.display()));
    }
    print_fmt!("kept        {} was edited and stays, but this capture is rejected", path.display());
    Ok(())
}

/// Whether a file is unchanged since [`write_arena`].
fn is_ours(path: &Path, work: &Work) -> bool {
    std::fs::read_to_string(work.mark()).is_ok_and(|mark| mark == digest(path))
}

/// Returns the hash of a file; empty if it cannot be read.
fn digest(path: &Path) -> String {
    let hash = std::fs::read(path).map(Sha256::digest);
    hash.map_or(String::new(), |hash| hex(&hash))
}

/// Returns a valid arena name from the name of the folder.
fn arena_name(output: &Path) -> String {
    let name = output.canonicalize().ok();
    let name =
        name.as_deref().and_then(Path::file_name).map_or("scene".into(), |n| n.to_string_lossy());
    let name: String = name.chars().filter(char::is_ascii_graphic).take(32).collect();
    if name.is_empty() { "scene".to_owned() } else { name }
}

/// Returns the cache key of a lens.
fn lens_key(k: &vizflyt_protocol::geometry::Intrinsics) -> String {
    format!("{k:?}")
}

fn metres(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("'{text}' is not a number"))?;
    if value > 0.0 && value <= 1000.0 {
        return Ok(value);
    }
    Err(format!("{value} m is not a length between 0 and 1000 m"))
}

fn length(text: &str) -> Result<Length, String> {
    let wrong = || format!("'{text}' is not a length between two tags; write it as 3,8=4.52");
    let (ids, value) = text.split_once('=').ok_or_else(wrong)?;
    let (a, b) = ids.split_once(',').ok_or_else(wrong)?;
    let id = |text: &str| text.trim().parse::<u32>().map_err(|_| wrong());
    let ids = [id(a)?, id(b)?];
    if ids[0] == ids[1] {
        return Err(wrong());
    }
    Ok(Length { ids, metres: metres(value.trim())? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_lengths() {
        assert_eq!(length("3,8=4.52"), Ok(Length { ids: [3, 8], metres: 4.52 }));
        for wrong in ["3,8", "3=4", "3,3=1", "a,8=4", "3,8=-1", "3,8=inf", "3,8=x", ""] {
            assert!(length(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn keeps_an_edited_arena() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("hall");
        let work = Work::open(&output, None).unwrap();
        let made = work.folder(Stage::Finish);
        std::fs::create_dir_all(&made).unwrap();
        let read = || std::fs::read_to_string(output.join("arena.toml")).ok();
        let write = |text: &str| {
            std::fs::write(made.join("arena.toml"), text).unwrap();
            write_arena(&output, &work).unwrap();
            read()
        };
        assert_eq!(write("one").as_deref(), Some("one"));
        assert_eq!(write("two").as_deref(), Some("two"));
        std::fs::write(output.join("arena.toml"), "mine").unwrap();
        assert_eq!(write("three").as_deref(), Some("mine"));
        remove_arena(&output, &work).unwrap();
        assert_eq!(read().as_deref(), Some("mine"));
        std::fs::remove_file(output.join("arena.toml")).unwrap();
        assert_eq!(write("four").as_deref(), Some("four"));
        remove_arena(&output, &work).unwrap();
        assert_eq!(read(), None);
    }
}
