//! `vizflyt scene bake`: converts splats into obstacles before the first flight, and prints a summary.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::sync::Mutex;

use anyhow::{Result, bail};
use clap::Args;
use serde::Serialize;
use tracing::warn;
use vizflyt_arena::check::{Finding, check_start};
use vizflyt_arena::{BakeSpec, Obstacles};
use vizflyt_process::print_line;
use vizflyt_server::scene::{
    BakeCache, Baked, BareArgs, bake_with, check_fit, is_in_an_arena, load,
};

/// Bake the obstacles of a scene, and store them for serve, demo and grade
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt scene bake my-forest
  vizflyt scene bake my-forest --voxel 0.1 --json")]
pub(crate) struct BakeArgs {
    /// arena.toml, its folder, or a scene file, which gets a default arena
    scene: PathBuf,
    #[command(flatten)]
    bare: BareArgs,
    /// Voxel size instead of that of [occupancy], for comparison
    #[arg(long, help_heading = "Scene", value_name = "METRES")]
    voxel: Option<f64>,
    /// Bake even if stored obstacles exist
    #[arg(long, help_heading = "Output")]
    force: bool,
    /// Print one JSON object
    #[arg(long, help_heading = "Output")]
    json: bool,
}

/// Output of `--json`.
#[derive(Debug, Serialize)]
struct BakeReport {
    splats: usize,
    voxel_m: f64,
    voxels: usize,
    /// Memory of the distance field, as in a server. [MB]
    memory_mb: f64,
    /// Whether the obstacles come from the cache.
    kept: bool,
    seconds: f64,
    /// Counts of the bake; absent if the obstacles come from the cache.
    #[serde(flatten)]
    #[serde(skip_serializing_if = "Option::is_none")]
    counts: Option<Counts>,
    #[serde(skip_serializing_if = "Option::is_none")]
    file: Option<String>,
}

#[derive(Debug, Serialize)]
struct Counts {
    occupied: usize,
    /// Occupied voxels that no ray of the capture has passed.
    unseen: usize,
    floating: usize,
    enclosed: usize,
    splats_left_out: usize,
}

/// Runs `vizflyt scene bake`.
pub(crate) fn run(args: &BakeArgs) -> Result<()> {
    let mut scene = load(&args.scene, &args.bare)?;
    if let Some(voxel_m) = args.voxel {
        scene.arena.occupancy.voxel_m = voxel_m;
        scene.arena.validate()?;
    }
    let spec = BakeSpec::of(&scene.arena);
    let cache = BakeCache::of_user();
    if let (Some(cache), true) = (&cache, args.force) {
        cache.forget(&scene.splats, &spec, scene.seen.as_ref())?;
    }
    let bar = Bar::default();
    let seen = scene.seen.as_ref();
    let baked = bake_with(&scene.splats, &spec, seen, cache.as_ref(), &|share| bar.show(share));
    Bar::clear();
    let report = BakeReport::of(&baked, scene.splats.len(), &spec);
    if args.json {
        print_line(serde_json::to_string(&report)?);
    } else {
        report.print();
    }
    let solid = baked.field.occupied_voxels();
    let mut findings = check_fit(&scene.splats, &scene.arena, &baked.field);
    let is_given = is_in_an_arena(&args.scene);
    if is_given {
        findings.extend(check_start(&scene.arena, &Obstacles::from(baked.field)));
    }
    refuse(&findings, is_given || solid == 0)
}

/// Rejects implausible scenes. For a default arena, which may only be a little off, it prints warnings instead.
fn refuse(findings: &[Finding], is_final: bool) -> Result<()> {
    if !is_final {
        for finding in findings {
            warn!("{finding}");
        }
        return Ok(());
    }
    if findings.is_empty() {
        return Ok(());
    }
    let lines: Vec<_> = findings.iter().map(ToString::to_string).collect();
    bail!("the scene does not fit its arena:\n  {}", lines.join("\n  "))
}

impl BakeReport {
    fn of(baked: &Baked, splats: usize, spec: &BakeSpec) -> Self {
        Self {
            splats,
            voxel_m: spec.grid.voxel_m,
            voxels: spec.grid.voxels(),
            memory_mb: baked.field.memory_bytes() as f64 / 1e6,
            kept: baked.counts.is_none(),
            seconds: baked.took.as_secs_f64(),
            counts: baked.counts.map(|counts| Counts {
                occupied: counts.occupied,
                unseen: counts.unseen,
                floating: counts.floating,
                enclosed: counts.enclosed,
                splats_left_out: counts.splats_left_out,
            }),
            file: baked.kept_at.as_ref().map(|path| path.display().to_string()),
        }
    }

    fn print(&self) {
        let how = if self.kept { "read" } else { "baked" };
        print_line(format!(
            "{how:<12} {} splats, {} voxels of {:.0} mm, {:.1} MB, in {:.2} s",
            self.splats,
            self.voxels,
            self.voxel_m * 1e3,
            self.memory_mb,
            self.seconds
        ));
        if let Some(counts) = &self.counts {
            print_line(format!(
                "obstacles    {} voxels solid, of which {} are unseen and {} were voids; {} floating voxels \
                 and {} faint or outside splats skipped",
                counts.occupied,
                counts.unseen,
                counts.enclosed,
                counts.floating,
                counts.splats_left_out
            ));
        }
        if let Some(file) = &self.file {
            print_line(format!("stored at    {file}"));
        }
    }
}

/// Progress bar on standard error, if it is a terminal.
#[derive(Debug, Default)]
struct Bar {
    /// Highest percentage shown; slabs finish in any order.
    shown: Mutex<u32>,
}

impl Bar {
    fn show(&self, share: f64) {
        let percent = (share * 100.0) as u32;
        let mut error = std::io::stderr();
        let Ok(mut shown) = self.shown.lock() else { return };
        if percent <= *shown || !error.is_terminal() {
            return;
        }
        *shown = percent;
        let filled = "#".repeat(percent as usize / 4);
        // A closed terminal must not stop the bake.
        let _ = write!(error, "\rbaking [{filled:<25}] {percent:3} %").and_then(|()| error.flush());
    }

    fn clear() {
        let mut error = std::io::stderr();
        if error.is_terminal() {
            let _ = write!(error, "\r{:<42}\r", "").and_then(|()| error.flush());
        }
    }
}
