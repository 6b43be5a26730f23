//! `vizflyt bench decode`: time from the last byte of an image to the plugin's memory, on the
//! vehicle's computer.

use anyhow::Result;
use clap::Args;
use vizflyt_process::print_fmt;
use vizflyt_runtime::bench;
use vizflyt_studio::scene::camera::ImageSize;

/// Measure the time to decode an image into the plugin's memory
///
/// Runs on one processor.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt bench decode                          check that this computer can decode 60 images a second
  vizflyt bench decode --size 1280x720 --json")]
pub(super) struct DecodeArgs {
    /// Image size
    #[arg(long, value_name = "WxH", default_value = "640x480")]
    size: ImageSize,
    /// Number of images to decode
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    images: u32,
    /// Print one JSON object
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
    // Decoding has its own thread, but its duration adds to the age of the image.
    let verdict = if figures.ms_p99 <= MOST_MS {
        "good"
    } else {
        "too slow for flight; close other programs, or use smaller images"
    };
    print_fmt!("at {RATE_HZ} Hz it may take {MOST_MS} ms (p99): {verdict}");
    Ok(())
}

/// Image rate of the requirement. [Hz]
const RATE_HZ: f64 = 60.0;
/// Maximum time for decoding, from docs/guides/jetson.md. [ms]
const MOST_MS: f64 = 10.0;
