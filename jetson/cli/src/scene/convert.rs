//! `vizflyt scene convert`: a scene of any format in any other.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;
use vizflyt_splat::format::{self, Format, Progress};

use crate::terminal::{print_fmt, print_line};

/// Converts a scene file to another format; the files' names decide, and content where it has a mark.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt scene convert scene.spz scene.ply
  vizflyt scene convert scene.ply scene.spz --variant 3
  vizflyt scene convert streamed/lod-meta.json coarse.ply --level 2")]
pub(crate) struct ConvertArgs {
    /// The scene: .ply, .compressed.ply, .splat, .spz, .sog, .ksplat, .glb, .gltf, or the folder of a SOG
    from: PathBuf,
    /// The file to write; a `meta.json` becomes a SOG scene of separate files
    to: PathBuf,
    /// Version of SPZ, or level of KSPLAT, to write
    #[arg(long, value_name = "N")]
    variant: Option<u32>,
    /// Level of a streamed scene (lod-meta.json) to read; 0 is the finest
    #[arg(long, value_name = "N", default_value_t = 0)]
    level: u32,
}

/// Converts.
pub(crate) fn run(args: &ConvertArgs) -> Result<()> {
    let start = Instant::now();
    let mut shown_s = 1;
    // Progress once a second.
    let mut show = |Progress { done, total }: Progress| {
        if start.elapsed().as_secs() >= shown_s {
            shown_s += 1;
            print_line(format!("{} %", done * 100 / total));
        }
    };
    let loaded = match args.level {
        0 => format::read_with_progress(&args.from, &mut show)?,
        level => format::read_level(&args.from, level)?,
    };
    print_fmt!(
        "{}: {} splats, degree {}, {} dropped, {:.0} ms",
        loaded.format,
        loaded.splats.len(),
        loaded.splats.sh_degree,
        loaded.dropped.total(),
        start.elapsed().as_secs_f64() * 1e3
    );
    for skipped in loaded.skipped_properties.iter().chain(&loaded.skipped_elements) {
        print_fmt!("left out: {skipped}");
    }
    let to = Format::of_name(&args.to);
    if loaded.splats.antialiased && to.is_some_and(|format| !format.keeps_antialiased()) {
        print_line(
            "trained with anti-aliasing, which no file of this format says: render with --antialiased on",
        );
    }
    match (args.variant, to) {
        (Some(variant), Some(format)) => {
            let bytes = format::encode_variant(format, variant, &loaded.splats)?;
            std::fs::write(&args.to, bytes)
                .with_context(|| format!("cannot write {}", args.to.display()))
        }
        _ => Ok(format::write(&args.to, &loaded.splats)?),
    }
}
