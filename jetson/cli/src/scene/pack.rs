//! `vizflyt scene pack`: a scene as a file that is rendered without being read whole.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use vizflyt_splat::{Detail, pack};

use crate::terminal::print_fmt;

/// Packs a scene larger than memory for rendering from the disk, in adaptive detail.
#[derive(Args, Debug)]
#[command(
    after_help = "A streamed scene (lod-meta.json) is read chunk by chunk, so that packing takes the memory of the \
largest; any other is read whole. The file takes some 80 bytes a splat without harmonics, 200 with all of them. `scene \
render` and `bench render` draw it within --memory; cameras are in the frame of the scene's file. What needs the splats \
themselves (arenas, `serve`, collisions, the other scene commands) takes the scene that it was packed of, not this.

Examples:
  vizflyt scene pack city/lod-meta.json city.packed
  vizflyt scene render city.packed --camera cam.json --memory 1024"
)]
pub(crate) struct PackArgs {
    /// The scene: of any format, or a streamed SOG (lod-meta.json, or its folder), of which the finest level is taken
    from: PathBuf,
    /// The file to write
    to: PathBuf,
}

/// Packs.
pub(super) fn run(args: &PackArgs) -> Result<()> {
    let start = Instant::now();
    let mut shown_s = 0;
    let summary = pack(&args.from, &args.to, Detail::ADAPTIVE_PX, |so_far| {
        // Progress once a second.
        if start.elapsed().as_secs() > shown_s {
            shown_s = start.elapsed().as_secs();
            print_fmt!("{} splats, parts: {}", so_far.splats, so_far.parts);
        }
    })?;
    print_fmt!(
        "{}: {} splats, parts: {}, {:.0} MB, {:.1} s",
        args.to.display(),
        summary.splats,
        summary.parts,
        std::fs::metadata(&args.to)?.len() as f64 / 1e6,
        start.elapsed().as_secs_f64()
    );
    Ok(())
}
