//! The options of `vizflyt scene view`, which the commands that edit on its page take, too.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;

use crate::render::{DetailKind, RendererKind};
use crate::scene::{Antialiased, BareArgs};

/// Opens a page with a free-flying camera in a scene.
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "On the page: W A S D to fly, E and Q up and down, drag to look around, wheel \
for the speed; on a touch screen one finger looks, two fly. `play` lets the clock of what moves \
run, where something does. `copy camera` gives the camera as a CAM.json for `vizflyt scene render`.

Examples:
  vizflyt scene view room.ply
  vizflyt scene view forest/arena.toml --renderer cpu
  vizflyt scene view room.ply --up z --http 0.0.0.0:8090 --no-browser"
)]
pub struct ViewArgs {
    /// Scene file of any format, or an arena.toml
    pub scene: PathBuf,

    /// Where the page is served; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0")]
    pub http: SocketAddr,

    /// What draws: a graphics card if one answers, the processor, or any graphics adapter
    #[arg(long, value_enum, value_name = "KIND", default_value_t)]
    pub renderer: RendererKind,

    /// How much of a large scene is drawn
    #[arg(long, value_enum, value_name = "HOW", default_value_t)]
    pub detail: DetailKind,

    /// Whether the scene was trained with anti-aliasing (mip-splatting); auto: as its arena says, else its file
    #[arg(long, value_enum, value_name = "HOW", default_value_t)]
    pub antialiased: Antialiased,

    /// How a scene without an arena is put into the world
    #[command(flatten)]
    pub bare: BareArgs,

    /// What the arena leaves to chance: where in their motion its objects begin
    #[arg(long, default_value_t = 7)]
    pub seed: u64,

    /// Only prints the address
    #[arg(long)]
    pub no_browser: bool,
}
