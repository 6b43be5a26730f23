//! `vizflyt scene edit`: floaters out, walls cropped, the inside carved; as steps that can be taken back.

mod request;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use vizflyt_process::print_fmt;
use vizflyt_server::render::{DetailKind, RendererKind};
use vizflyt_server::scene::{
    Antialiased, BareArgs, Editor, Up, is_in_an_arena, list_path, read_list, result_path,
    scene_file,
};
use vizflyt_server::{ViewArgs, web};
use vizflyt_splat::edit::EditStep;

use self::request::{CarveSettings, Requests};
use crate::page::show_page;

/// Crops, cleans, carves, thins out, turns and converts a scene; every step can be taken back.
#[derive(Args, Debug)]
#[command(
    after_help = "The scene's file stays as it is. The steps go into a list beside it (room.ply.edits.toml), which names the
original by its hash, and the result into a file of its own (room.edited.ply, or -o). Lengths and coordinates are in
the file's own axes and units, as the steps before leave them. On the page a selection can also be named, as a part
of the scene for `vizflyt dataset --parts` (room.ply.parts.toml).

Examples:
  vizflyt scene edit room.ply --min-opacity 0.02 --drop-floaters --keep-parts
  vizflyt scene edit room.ply --crop-box -18,-12,4:15,8,22 -o room.spz
  vizflyt scene edit room.ply --carve 0,-2,12 --decimate 50%
  vizflyt scene edit room.ply --page
  vizflyt scene edit room.ply --list
  vizflyt scene edit room.ply --undo
  vizflyt scene edit room.ply --apply -o room.glb"
)]
pub(crate) struct EditArgs {
    /// Scene file of any format, or an arena.toml (then its scene)
    scene: PathBuf,
    /// Where the edited scene goes, in the format of its name [default: NAME.edited.* beside the original]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Prints the steps so far
    #[arg(long, conflicts_with_all = ["undo", "apply", "page", "output"])]
    list: bool,
    /// Takes the last N steps back, the newest first
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "1", conflicts_with_all = ["apply", "page"])]
    undo: Option<usize>,
    /// Writes the edited scene again, from the original and the list
    #[arg(long)]
    apply: bool,
    /// Opens a page on which a lasso and a box select what goes, or what gets a name
    #[arg(long)]
    page: bool,
    /// Where the page is served; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0", requires = "page")]
    http: SocketAddr,
    /// What draws the page's pictures
    #[arg(long, value_enum, value_name = "KIND", default_value_t, requires = "page")]
    renderer: RendererKind,
    /// Only prints the page's address
    #[arg(long, requires = "page")]
    no_browser: bool,
    #[command(flatten)]
    steps: Requests,
    /// How wide --carve's free space must be around the path, and in gaps [default: 2 cells]
    #[arg(long, value_name = "LENGTH", requires = "carve")]
    carve_radius: Option<f64>,
    /// How much --carve leaves of a wall, behind its face [default: 3 cells]
    #[arg(long, value_name = "LENGTH", requires = "carve")]
    carve_depth: Option<f64>,
    /// Side of --carve's cells [default: a 30th of the core's shortest side]
    #[arg(long, value_name = "LENGTH", requires = "carve")]
    carve_cell: Option<f64>,
    /// How far --carve looks [default: the core's longest side]
    #[arg(long, value_name = "LENGTH", requires = "carve")]
    carve_reach: Option<f64>,
}

/// Runs `vizflyt scene edit`.
pub(crate) fn run(args: &EditArgs) -> Result<()> {
    let original = scene_file(&args.scene)?;
    let has_steps = !args.steps.0.is_empty();
    if args.list {
        ensure!(!has_steps, "--list changes nothing; give steps without it");
        return print_list(&original);
    }
    if args.undo.is_some() {
        ensure!(!has_steps, "--undo takes steps back; give new ones in a command of their own");
    }
    if !(has_steps || args.undo.is_some() || args.apply || args.page) {
        bail!(
            "nothing to do; give a step such as --drop-floaters, or --page, --list, --undo or --apply"
        );
    }
    let output = args.output.clone().unwrap_or_else(|| result_path(&original));
    let start = Instant::now();
    let mut editor = Editor::open_without_last(&original, args.undo.unwrap_or(0))?;
    let read_ms = elapsed_ms(start);
    print_fmt!(
        "scene       {}: {} splats, {read_ms:.0} ms",
        original.display(),
        editor.splats().len()
    );
    let carve = CarveSettings {
        radius: args.carve_radius,
        depth: args.carve_depth,
        cell: args.carve_cell,
        reach: args.carve_reach,
    };
    for request in &args.steps.0 {
        let start = Instant::now();
        let step = request.step(editor.splats(), &carve);
        let said = step.to_string();
        let taken = editor.apply(step).with_context(|| said.clone())?;
        print_fmt!(
            "step {:<6} {said}: {taken} splats away, {:.0} ms",
            editor.steps().len(),
            elapsed_ms(start)
        );
    }
    if args.page {
        return page(args, editor, output);
    }
    let start = Instant::now();
    editor.save(&output)?;
    let left = editor.splats().len();
    print_fmt!("written     {}: {left} splats, {:.0} ms", output.display(), elapsed_ms(start));
    let steps = editor.steps().len();
    print_fmt!(
        "steps       {steps}, in {}; --undo takes the last one back",
        list_path(&original).display()
    );
    if args.scene != original {
        print_fmt!(
            "next        name {} as the scene's file in {}",
            output.display(),
            args.scene.display()
        );
    }
    Ok(())
}

fn elapsed_ms(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

fn print_list(original: &Path) -> Result<()> {
    let Some(list) = read_list(original)? else {
        print_fmt!("{} has no edits", original.display());
        return Ok(());
    };
    print_fmt!("scene       {}: {} splats", list.scene.file, list.scene.splats);
    for (index, done) in list.steps.iter().enumerate() {
        print_fmt!("step {:<6} {}: {} splats away", index + 1, done.edit, done.taken);
    }
    Ok(())
}

fn page(args: &EditArgs, editor: Editor, output: PathBuf) -> Result<()> {
    // What has been turned here is upright now; what has been scaled is in metres.
    let has = |kind: fn(&EditStep) -> bool| editor.steps().iter().any(|done| kind(&done.edit));
    let bare = BareArgs {
        up: has(|step| matches!(step, EditStep::Turn { .. })).then_some(Up::Z),
        scale: has(|step| matches!(step, EditStep::Scale { .. })).then_some(1.0),
    };
    let view = ViewArgs {
        scene: args.scene.clone(),
        http: args.http,
        renderer: args.renderer,
        detail: DetailKind::default(),
        antialiased: Antialiased::default(),
        bare: if is_in_an_arena(&args.scene) { BareArgs::default() } else { bare },
        seed: 7,
        no_browser: args.no_browser,
    };
    web::edit(view, editor, output, show_page(args.no_browser))
}
