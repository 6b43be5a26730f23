//! `vizflyt scene pack`: a scene as a file that is rendered without being read whole.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use vizflyt_process::print_fmt;
use vizflyt_server::scene::placed;
use vizflyt_splat::{Detail, pack};

/// Packs a scene larger than memory for rendering from the disk, in adaptive detail.
#[derive(Args, Debug)]
#[command(
    after_help = "A streamed scene (lod-meta.json) is read chunk by chunk, so that packing takes the memory of the \
largest; any other is read whole. The file takes some 80 bytes a splat without harmonics, 200 with all of them. `scene \
render` and `bench render` draw it within --memory. An arena.toml that names it (scene = \"city.packed\") is flown in; it lies \
where it was packed, in metres of the world: give the arena.toml of the scene itself where [scene] places it. The other \
scene commands, and graded flights, take the scene that it was packed of, not this.

Examples:
  vizflyt scene pack city/lod-meta.json city.packed
  vizflyt scene pack lab/arena.toml lab.packed
  vizflyt scene render city.packed --camera cam.json --memory 1024"
)]
pub(crate) struct PackArgs {
    /// The scene: of any format, or a streamed SOG (lod-meta.json, or its folder), of which the finest level is taken; or an
    /// arena.toml, which places its scene
    from: PathBuf,
    /// The file to write
    to: PathBuf,
}

/// Packs.
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
