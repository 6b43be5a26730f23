//! Decodes a number of 640x480 RGB-D images for a plugin, and prints the latency. Used to count instructions on
//! computers where times are not meaningful.
//!
//! `cargo run -p vizflyt-runtime --example decode -- 20`

fn main() -> anyhow::Result<()> {
    let count = std::env::args().nth(1).unwrap_or_else(|| "100".to_owned());
    let figures = vizflyt_runtime::bench::decode([640, 480], count.parse()?)?;
    println!("{}", serde_json::to_string(&figures)?);
    Ok(())
}
