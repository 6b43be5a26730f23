//! Reads a scene of any format and writes it in any other, determined by the names, in one of its variants
//! where it has several (`Format::variants`):
//!
//! ```text
//! cargo run --release -p vizflyt-splat --example convert -- scene.ksplat scene.spz [4]
//! ```

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use vizflyt_splat::format::{self, Format, Progress};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [from, to, variant @ ..] = &arguments[..] else {
        return Err("usage: convert IN OUT [VARIANT]".into());
    };
    let start = Instant::now();
    let mut shown_s = 1;
    let loaded = format::read_with_progress(from, &mut |Progress { done, total }| {
        // Only what takes more than a second says how far it is, once a second.
        if start.elapsed().as_secs() >= shown_s {
            shown_s += 1;
            eprintln!("{} %", done * 100 / total);
        }
    })?;
    println!(
        "{}: {} splats, degree {}, {} dropped, {:.0} ms",
        loaded.format,
        loaded.splats.len(),
        loaded.splats.sh_degree,
        loaded.dropped.total(),
        start.elapsed().as_secs_f64() * 1e3
    );
    for skipped in loaded.skipped_properties.iter().chain(&loaded.skipped_elements) {
        println!("left out: {skipped}");
    }
    match (variant, Format::of_name(to)) {
        ([variant], Some(format)) => {
            let variant = variant.to_string_lossy().parse()?;
            std::fs::write(to, format::encode_variant(format, variant, &loaded.splats)?)?;
        }
        _ => format::write(to, &loaded.splats)?,
    }
    Ok(())
}
