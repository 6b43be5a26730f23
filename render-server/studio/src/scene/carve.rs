//! `vizflyt scene carve`: determines from the photos of a capture which space is free, and writes it next to the scene.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::Args;
use serde::Serialize;
use toml_edit::{DocumentMut, Item, Table, value};
use vizflyt_arena::check::check_start;
use vizflyt_arena::seen::ScenePlace;
use vizflyt_arena::{ArenaConfig, BakeSpec, Obstacles};
use vizflyt_process::print_fmt;
use vizflyt_server::scene::{Placement, Seen, bake_with, write_seen};
use vizflyt_splat::Splats;
use vizflyt_splat::format::{self, Format};
use vizflyt_twin::Dataset;
use vizflyt_twin::align::Similarity;
use vizflyt_twin::carve::{CarveCounts, CarveOptions, Voxels, carve};

/// Carve a scene with the photos of its capture
///
/// Space that photos look through is free; everything else is solid. Floaters are removed.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt scene carve my-hall --capture my-capture
  vizflyt scene carve my-hall --capture my-capture --no-prune --report carve.json

--capture is the dataset from which the scene was trained, in the frame of the scene file: a folder of COLMAP, or of
nerfstudio (transforms.json). Align the scene (vizflyt scene align) before you carve it.")]
pub(crate) struct CarveArgs {
    /// Arena with a scene file, as made by `vizflyt arena new`
    pub(crate) arena: PathBuf,
    /// Photos with poses from which the scene was trained
    #[arg(long, value_name = "DATASET")]
    pub(crate) capture: PathBuf,
    /// Maximum image width; wider photos are downscaled [px]
    #[arg(long, default_value_t = 320, value_name = "PX", value_parser = clap::value_parser!(u32).range(16..=8192))]
    pub(crate) width: u32,
    /// Minimum number of photos that must look through a free voxel
    #[arg(long, default_value_t = 2, value_name = "N", value_parser = clap::value_parser!(u8).range(1..))]
    pub(crate) photos: u8,
    /// Radius around each camera position that is assumed free [m]
    #[arg(long, default_value_t = 0.1, value_name = "METRES", value_parser = radius)]
    pub(crate) camera_radius: f64,
    /// Keep all splats; only write the free space
    #[arg(long)]
    pub(crate) no_prune: bool,
    /// File for the results, as JSON
    #[arg(long, value_name = "FILE.json")]
    pub(crate) report: Option<PathBuf>,
}

/// Output of `--report`.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct CarveReport {
    scene: String,
    splats_before: usize,
    splats: usize,
    /// Number of voxels that contain splats, before and after.
    occupied_before: usize,
    occupied: usize,
    /// Number of voxels without splats that were not seen to be free; they are solid for the referee.
    unseen: usize,
    /// Share of the fence's voxels above the floor that were seen, 0 to 1.
    seen_of_fence: f64,
    #[serde(flatten)]
    counts: CarveCounts,
}

/// Runs `vizflyt scene carve`.
pub(crate) fn run(args: &CarveArgs) -> Result<()> {
    let report = carve_arena(args)?;
    print_fmt!(
        "pruned      {} of {} splats: {} looked through, {} on the camera's path, {} that no photo shows",
        report.splats_before - report.splats,
        report.splats_before,
        report.counts.looked_through,
        report.counts.on_path,
        report.counts.hidden
    );
    print_fmt!(
        "obstacles   {} voxels before, {} now; {} more are unseen, and solid",
        report.occupied_before,
        report.occupied,
        report.unseen
    );
    print_fmt!(
        "seen        {:.0} % of the fence from the floor up, in {:.1} s",
        100.0 * report.seen_of_fence,
        report.counts.seconds
    );
    if report.counts.points > 0 {
        print_fmt!(
            "points      {:.1} % of the points of structure from motion are hidden in the twin",
            100.0 * report.counts.hidden_points as f64 / report.counts.points as f64
        );
    }
    print_fmt!("written     {}.seen", report.scene);
    print_fmt!("next        vizflyt arena check {}", args.arena.display());
    if let Some(path) = &args.report {
        let text = serde_json::to_string_pretty(&report)?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(())
}

/// Carves the scene of an arena: writes the scene, the seen space, and `[occupancy]`.
pub(crate) fn carve_arena(args: &CarveArgs) -> Result<CarveReport> {
    let file = if args.arena.is_dir() { args.arena.join("arena.toml") } else { args.arena.clone() };
    let is_arena = file.extension().is_some_and(|extension| extension == "toml") && file.is_file();
    let path = args.arena.display();
    ensure!(
        is_arena,
        "{path} is not an arena; create one for the scene: vizflyt arena new FOLDER --scene {path}"
    );
    let text = std::fs::read_to_string(&file)
        .with_context(|| format!("cannot read {}", file.display()))?;
    let arena = ArenaConfig::parse(&text).with_context(|| file.display().to_string())?;
    let scene = arena.scene_path(&file);
    let can_write = Format::of_name(&scene).is_some() && scene.is_file();
    ensure!(
        can_write || args.no_prune,
        "{} cannot be written again; convert it first (vizflyt scene convert), or give --no-prune",
        scene.display()
    );
    let splats = format::read(&scene)
        .with_context(|| format!("cannot use scene {}", scene.display()))?
        .splats;
    let dataset = Dataset::read(&args.capture, Some(args.width))?;
    let place = ScenePlace::of(&arena.scene);
    let world_from_scene = Similarity {
        scale: place.metres_per_unit,
        rotation: place.rotation,
        translation_m: place.origin_m,
    };
    let spec = BakeSpec::of(&arena);
    let grid = spec.grid;
    let voxels = Voxels { min_m: grid.min_m, side_m: grid.voxel_m, size: grid.size };
    let options = CarveOptions {
        photos: args.photos,
        camera_radius_m: args.camera_radius,
        ..CarveOptions::default()
    };
    let mut carved = carve(&dataset, &splats, &world_from_scene, voxels, &options);
    ensure!(
        carved.counts.seen > 0,
        "no photo of {} looks into the fence of {}; was the scene trained from it, and is it aligned \
         (vizflyt scene align)?",
        args.capture.display(),
        file.display()
    );
    if args.no_prune {
        carved.splats.clone_from(&splats);
        let counts = &mut carved.counts;
        (counts.looked_through, counts.on_path, counts.hidden) = (0, 0, 0);
    }
    let changed = carved.splats.len() != splats.len();
    ensure!(
        !carved.splats.is_empty(),
        "no splat of {} is in the view of {}; was the scene trained from it?",
        scene.display(),
        args.capture.display()
    );
    if changed {
        keep_first(&scene)?;
        format::write(&scene, &carved.splats)?;
    }
    let seen = write_seen(&scene, grid, place, carved.seen.bits)?;
    let solid = with_unseen_solid(&text)?;
    ArenaConfig::parse(&solid).context("the arena would not be read again")?;
    std::fs::write(&file, solid).with_context(|| format!("cannot write {}", file.display()))?;

    let placed = |splats: &Splats| {
        let mut placed = splats.clone();
        Placement::of(&arena.scene).apply(&mut placed);
        placed
    };
    let seen_of_fence = seen_of_fence(&seen, &arena);
    let before = bake_with(&placed(&splats), &spec, None, None, &|_| ());
    let after = bake_with(&placed(&carved.splats), &spec, Some(&seen), None, &|_| ());
    for finding in check_start(&arena, &Obstacles::from(after.field)) {
        tracing::warn!("{finding}");
    }
    let (before, after) = (before.counts.unwrap_or_default(), after.counts.unwrap_or_default());
    Ok(CarveReport {
        scene: scene.display().to_string(),
        splats_before: splats.len(),
        splats: carved.splats.len(),
        occupied_before: before.occupied,
        occupied: after.occupied - after.unseen,
        unseen: after.unseen,
        seen_of_fence,
        counts: carved.counts,
    })
}

/// Returns the share of the fence's voxels above the floor that was seen.
fn seen_of_fence(Seen { space, place }: &Seen, arena: &ArenaConfig) -> f64 {
    let (seen, grid, fence) = (space.at(place), space.grid(), &arena.geofence);
    let [nx, ny, nz] = grid.size;
    let (mut inside, mut of_them) = (0usize, 0usize);
    for n in 0..nx * ny * nz {
        let center_m = grid.center_m([n / (ny * nz), n / nz % ny, n % nz]);
        if center_m.cmpge(fence.min_m).all() && center_m.cmple(fence.max_m).all() {
            inside += 1;
            of_them += usize::from(seen.is_seen(center_m));
        }
    }
    of_them as f64 / inside.max(1) as f64
}

/// Copies the scene before it is carved for the first time: `hall.uncarved.ply`.
fn keep_first(scene: &Path) -> Result<()> {
    let stem = scene.file_stem().unwrap_or_default().to_string_lossy();
    let extension = scene.extension().unwrap_or_default().to_string_lossy();
    let kept = scene.with_file_name(format!("{stem}.uncarved.{extension}"));
    if !kept.exists() {
        std::fs::copy(scene, &kept)
            .with_context(|| format!("cannot keep {} at {}", scene.display(), kept.display()))?;
        print_fmt!("copied      the original to {}", kept.display());
    }
    Ok(())
}

/// Sets `unseen = "solid"` in the text of an arena.toml; all other text and comments stay.
fn with_unseen_solid(text: &str) -> Result<String> {
    let mut document: DocumentMut = text.parse()?;
    if document.get("occupancy").is_none() {
        document.insert("occupancy", Item::Table(Table::new()));
    }
    document["occupancy"]["unseen"] = value("solid");
    Ok(document.to_string())
}

fn radius(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(metres) if (0.0..=2.0).contains(&metres) => Ok(metres),
        _ => Err(format!("'{text}' is not a radius of 0 to 2 m")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_key_unseen_changes() {
        for (text, expected) in [
            (
                "a = 1 # one\n\n[b]\nc = 2\n",
                "a = 1 # one\n\n[b]\nc = 2\n\n[occupancy]\nunseen = \"solid\"\n",
            ),
            (
                "[occupancy]\nvoxel_m = 0.1 # coarse\nunseen = \"free\"\n[b]\n",
                "[occupancy]\nvoxel_m = 0.1 # coarse\nunseen = \"solid\"\n[b]\n",
            ),
            (
                "occupancy = { voxel_m = 0.1 }\n[b]\n",
                "occupancy = { voxel_m = 0.1 , unseen = \"solid\" }\n[b]\n",
            ),
        ] {
            let solid = with_unseen_solid(text).unwrap();
            assert_eq!(solid.replace(' ', ""), expected.replace(' ', ""));
            assert_eq!(with_unseen_solid(&solid).unwrap(), solid, "twice is once");
        }
    }
}
