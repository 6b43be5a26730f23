//! Options of `vizflyt scene view`, shared with the commands that edit on its page.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;

use crate::render::{DetailKind, RendererKind};
use crate::scene::{Antialiased, BareArgs};

/// Open a page with a free-flying camera in a scene
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "On the page: W A S D to fly, E and Q up and down, drag to look around, wheel \
for the speed; on a touch screen one finger looks, two fly. `play` runs the clock of moving \
objects. `copy camera` copies the camera as a CAM.json for `vizflyt scene render`.

Examples:
  vizflyt scene view room.ply
  vizflyt scene view forest/arena.toml --renderer cpu
  vizflyt scene view room.ply --up z --http 0.0.0.0:8090 --no-browser"
)]
pub struct ViewArgs {
    /// Scene file of any format, or an arena.toml
    pub scene: PathBuf,

    /// Placement of a scene without an arena
    #[command(flatten)]
    pub bare: BareArgs,

    /// Seed of the initial phase of moving objects that set none
    #[arg(long, help_heading = "Scene", default_value_t = 7)]
    pub seed: u64,

    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    pub renderer: RendererKind,

    /// Level of detail for large scenes
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    pub detail: DetailKind,

    /// Whether the scene was trained with anti-aliasing (mip-splatting)
    ///
    /// auto: as in the arena, or else as in the scene's file.
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    pub antialiased: Antialiased,

    /// Address of the page; port 0 selects a free one
    #[arg(long, help_heading = "Web page", value_name = "ADDR", default_value = "127.0.0.1:0")]
    pub http: SocketAddr,

    /// Only print the page's address
    #[arg(long, help_heading = "Web page")]
    pub no_browser: bool,
}
