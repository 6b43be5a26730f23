//! `vizflyt bench decode`: what the vehicle's computer takes for an image, from its last byte to the plugin's memory.

use anyhow::Result;
use clap::Args;
use vizflyt_process::print_fmt;
use vizflyt_runtime::bench;
use vizflyt_studio::scene::camera::ImageSize;

/// Decodes images into the plugin's memory, on one processor; prints how long they take.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt bench decode                          may this computer fly at 60 images a second?
  vizflyt bench decode --size 1280x720 --json")]
pub(super) struct DecodeArgs {
    /// Size of the images
    #[arg(long, value_name = "WxH", default_value = "640x480")]
    size: ImageSize,
    /// How many are decoded
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    images: u32,
    /// Prints one JSON object
    #[arg(long)]
    json: bool,
}

/// Runs `vizflyt bench decode`.
pub(super) fn run(args: &DecodeArgs) -> Result<()> {
    let ImageSize { width_px, height_px } = args.size;
    let figures = bench::decode([width_px, height_px], args.images as usize)?;
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&figures)?);
        return Ok(());
    }
    print_fmt!(
        "{width_px}x{height_px} RGB-D of {} KB: p50 {:.2} ms, p99 {:.2}, max {:.2}, to the plugin's memory",
        figures.bytes / 1000,
        figures.ms_p50,
        figures.ms_p99,
        figures.ms_max
    );
    // Decoding has a thread of its own, but an image is so much older when the plugin sees it.
    let verdict = if figures.ms_p99 <= MOST_MS {
        "good"
    } else {
        "too slow to fly with; end what else runs, or give smaller images"
    };
    print_fmt!("at {RATE_HZ} Hz it may take {MOST_MS} ms (p99): {verdict}");
    Ok(())
}

/// What images come at. [Hz]
const RATE_HZ: f64 = 60.0;
/// What decoding may take of it, for docs/guides/jetson.md. [ms]
const MOST_MS: f64 = 10.0;
