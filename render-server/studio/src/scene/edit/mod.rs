//! `vizflyt scene edit`: crops, cleans and carves a scene, as a list of steps that can be undone.

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

/// Crop, clean, carve, decimate, transform and convert a scene, with undo
#[derive(Args, Debug)]
#[command(
    after_help = "The scene file does not change. The steps are stored in a list next to it (room.ply.edits.toml), with the hash of the
original. The result is a separate file (room.edited.ply, or -o). Lengths and coordinates are in the axes and units of
the file after the previous steps. On the page, a selection can also get a name, as a part of the scene for
`vizflyt dataset --parts` (room.ply.parts.toml).

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
    /// Edited scene file [default: NAME.edited.* next to the original]
    ///
    /// The name determines the format.
    #[arg(short, long, help_heading = "Output", value_name = "FILE")]
    output: Option<PathBuf>,
    /// Print the list of steps
    #[arg(long, help_heading = "History", conflicts_with_all = ["undo", "apply", "page", "output"])]
    list: bool,
    /// Undo the last N steps
    #[arg(long, help_heading = "History", value_name = "N", num_args = 0..=1, default_missing_value = "1", conflicts_with_all = ["apply", "page"])]
    undo: Option<usize>,
    /// Write the edited scene again, from the original and the list of steps
    #[arg(long, help_heading = "History")]
    apply: bool,
    /// Open a page to select splats with lasso and box, to delete or name them
    #[arg(long, help_heading = "Web page")]
    page: bool,
    /// Address of the page; port 0 selects a free one
    #[arg(
        long,
        help_heading = "Web page",
        value_name = "ADDR",
        default_value = "127.0.0.1:0",
        requires = "page"
    )]
    http: SocketAddr,
    /// Renderer of the page's images
    #[arg(
        long,
        help_heading = "Web page",
        value_enum,
        value_name = "KIND",
        default_value_t,
        requires = "page"
    )]
    renderer: RendererKind,
    /// Only print the page's address
    #[arg(long, help_heading = "Web page", requires = "page")]
    no_browser: bool,
    #[command(flatten)]
    steps: Requests,
    /// Minimum width of --carve's free space around the path [default: 2 cells]
    #[arg(long, help_heading = "Details of --carve", value_name = "LENGTH", requires = "carve")]
    carve_radius: Option<f64>,
    /// Thickness of walls that --carve keeps behind their face [default: 3 cells]
    #[arg(long, help_heading = "Details of --carve", value_name = "LENGTH", requires = "carve")]
    carve_depth: Option<f64>,
    /// Edge length of --carve's cells [default: 1/30 of the core's shortest side]
    #[arg(long, help_heading = "Details of --carve", value_name = "LENGTH", requires = "carve")]
    carve_cell: Option<f64>,
    /// Maximum viewing distance of --carve [default: the core's longest side]
    #[arg(long, help_heading = "Details of --carve", value_name = "LENGTH", requires = "carve")]
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
        ensure!(!has_steps, "--undo removes steps; give new ones in a separate command");
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
            "step {:<6} {said}: {taken} splats removed, {:.0} ms",
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
        "steps       {steps}, in {}; --undo removes the last one",
        list_path(&original).display()
    );
    if args.scene != original {
        print_fmt!(
            "next        set {} as the scene file in {}",
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
        print_fmt!("step {:<6} {}: {} splats removed", index + 1, done.edit, done.taken);
    }
    Ok(())
}

fn page(args: &EditArgs, editor: Editor, output: PathBuf) -> Result<()> {
    // After a rotation step the scene is upright; after a scale step it is in metres.
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
