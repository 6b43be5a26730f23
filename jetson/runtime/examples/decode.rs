//! Decodes as many 640x480 RGB-D images as its argument says, for a plugin, and prints what they took; for counting its
//! instructions, where a time means nothing.
//!
//! `cargo run -p vizflyt-runtime --example decode -- 20`

fn main() -> anyhow::Result<()> {
    let count = std::env::args().nth(1).unwrap_or_else(|| "100".to_owned());
    let figures = vizflyt_runtime::bench::decode([640, 480], count.parse()?)?;
    println!("{}", serde_json::to_string(&figures)?);
    Ok(())
}
