//! `vizflyt arena edit`: edits a course by dragging in the twin, and writes it into the arena.toml.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result};
use clap::Args;
use vizflyt_process::print_line;
use vizflyt_server::ViewArgs;
use vizflyt_server::render::{DetailKind, RendererKind};
use vizflyt_server::scene::{Antialiased, BareArgs};
use vizflyt_server::web::{self, Course, CourseFile, Line};
use vizflyt_splat::{Splats, ply};

use super::file;
use crate::page::show_page;

/// Open a page to edit a course in the twin
///
/// Edits start, goal, fence, no-fly boxes, gates and moving objects.
#[derive(Args, Debug)]
#[command(
    after_help = "The page shows the twin as the vehicle's cameras see it. Dragged objects snap to 5 cm, to the floor and to the fence.
Each change is checked as by `vizflyt arena check`, and can be undone. Saving writes only changed keys: comments stay.
Frames of gates and boxes become splats in models/ next to the file; cameras see them, and vehicles can hit them.

Examples:
  vizflyt arena new my-arena --scene room.ply --up -y --scale 0.176
  vizflyt arena edit my-arena
  vizflyt demo --scene my-arena"
)]
pub(super) struct EditArgs {
    /// arena.toml or its folder
    arena: PathBuf,
    /// Address of the page; port 0 selects a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0")]
    http: SocketAddr,
    /// Renderer of the page's images
    #[arg(long, value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Only print the page's address
    #[arg(long)]
    no_browser: bool,
}

/// Runs `vizflyt arena edit` until it is interrupted.
pub(super) fn run(args: &EditArgs) -> Result<()> {
    let path = file::find(&args.arena)?;
    let view = ViewArgs {
        scene: path.clone(),
        http: args.http,
        renderer: args.renderer,
        detail: DetailKind::default(),
        antialiased: Antialiased::default(),
        bare: BareArgs::default(),
        seed: 0,
        no_browser: args.no_browser,
    };
    web::set_up(view, Arc::new(ArenaFile { path }), show_page(args.no_browser))
}

struct ArenaFile {
    path: PathBuf,
}

impl CourseFile for ArenaFile {
    fn save(&self, course: &Course, models: &[(PathBuf, Arc<Splats>)]) -> Result<Vec<Line>> {
        // The models must exist before the file refers to them.
        for (path, splats) in models {
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder)
                    .with_context(|| format!("cannot make the folder {}", folder.display()))?;
            }
            ply::write(path, splats).with_context(|| format!("cannot write {}", path.display()))?;
        }
        file::change(&self.path, |document| {
            if let Some(goal) = &course.goal {
                file::put(document, "goal", goal)?;
            } else {
                document.remove("goal");
            }
            file::set(document.as_table_mut(), "takeoff_height_m", course.takeoff_height_m.into());
            file::put(document, "spawn", &course.spawn)?;
            file::put(document, "geofence", &course.geofence)?;
            file::put_list(document, "no_fly", &course.no_fly)?;
            file::put_list(document, "stages", &course.stages)?;
            file::put_list(document, "objects", &course.objects)
        })?;
        let path = self.path.display();
        print_line(format!("written     {path}"));
        let mut said = vec![Line { key: "written", text: path.to_string() }];
        if !models.is_empty() {
            let text = format!("{} new in models/", models.len());
            said.push(Line { key: "models", text });
        }
        said.push(Line { key: "next", text: format!("vizflyt demo --scene {path}") });
        Ok(said)
    }
}
