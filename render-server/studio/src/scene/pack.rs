//! `vizflyt scene pack`: writes a packed scene, which is rendered block by block from the disk.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use vizflyt_process::print_fmt;
use vizflyt_server::scene::placed;
use vizflyt_splat::{Detail, pack};

/// Pack a scene larger than memory, to render it from the disk
///
/// Packed scenes are rendered with adaptive detail.
#[derive(Args, Debug)]
#[command(
    after_help = "A streamed scene (lod-meta.json) is read chunk by chunk, so that packing needs the memory of its \
largest chunk; any other scene is read at once. The file has about 80 bytes per splat without harmonics, 200 with all of \
them. `scene render` and `bench render` render it within --memory. For flights, name it in an arena.toml (scene = \
\"city.packed\"). A packed scene is in metres of the world: if the original has a [scene] placement, pack its arena.toml. \
The other scene commands, and graded flights, need the original scene.

Examples:
  vizflyt scene pack city/lod-meta.json city.packed
  vizflyt scene pack lab/arena.toml lab.packed
  vizflyt scene render city.packed --camera cam.json --memory 1024"
)]
pub(crate) struct PackArgs {
    /// Scene of any format, streamed SOG, or an arena.toml, which places its scene
    ///
    /// Of a streamed SOG (lod-meta.json, or its folder), the finest level is packed.
    from: PathBuf,
    /// File to write
    to: PathBuf,
}

/// Runs `vizflyt scene pack`.
pub(super) fn run(args: &PackArgs) -> Result<()> {
    let start = Instant::now();
    let mut shown_s = 0;
    let (scene, place) = placed(&args.from)?;
    let summary = pack(&scene, &args.to, Detail::ADAPTIVE_PX, place, |so_far| {
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
