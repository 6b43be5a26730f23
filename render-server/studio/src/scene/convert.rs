//! `vizflyt scene convert`: converts a scene to another format, with optional rotation and scale.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;
use glam::{DQuat, DVec3, EulerRot};
use vizflyt_arena::config::Up;
use vizflyt_process::{print_fmt, print_line};
use vizflyt_server::scene::{WorldFromScene, parse_scale};
use vizflyt_splat::format::{self, Format, Progress};

/// Convert a scene file to another format
///
/// File names determine the formats; for input files with a magic number, the content does.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt scene convert scene.spz scene.ply
  vizflyt scene convert scene.ply scene.spz --variant 3
  vizflyt scene convert room.ply upright.ply --up -y --rotate 0,0,90 --scale 0.176
  vizflyt scene convert streamed/lod-meta.json coarse.ply --level 2")]
pub(crate) struct ConvertArgs {
    /// Scene: .ply, .compressed.ply, .splat, .spz, .sog, .ksplat, .glb, .gltf
    ///
    /// Or the folder of a SOG.
    from: PathBuf,
    /// File to write; `meta.json` writes a SOG scene of separate files
    to: PathBuf,
    /// Version of SPZ, or level of KSPLAT, to write
    #[arg(long, value_name = "N")]
    variant: Option<u32>,
    /// Rotate the scene so that this axis becomes +z: x, -x, y, -y, z or -z
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    up: Option<Up>,
    /// Then rotate it about x, then y, then z, counter-clockwise [deg]
    #[arg(long, value_name = "X,Y,Z", value_parser = degrees, allow_hyphen_values = true)]
    rotate: Option<DVec3>,
    /// Scale the scene by this factor: metres per unit make it metric
    #[arg(long, value_name = "FACTOR", value_parser = parse_scale)]
    scale: Option<f64>,
    /// Level of a streamed scene (lod-meta.json) to read; 0 is the finest
    #[arg(long, value_name = "N", default_value_t = 0)]
    level: u32,
}

impl ConvertArgs {
    fn world_from_scene(&self) -> WorldFromScene {
        let upright = self.up.unwrap_or(Up::Z).world_from_scene();
        let rotation = self.rotate.map_or(upright, |deg| {
            let rad = deg.map(f64::to_radians);
            DQuat::from_euler(EulerRot::ZYX, rad.z, rad.y, rad.x) * upright
        });
        let scale = self.scale.unwrap_or(1.0);
        WorldFromScene { scale, rotation, translation_m: DVec3::ZERO }
    }
}

/// Parses three angles.
fn degrees(text: &str) -> Result<DVec3, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    let good = numbers.iter().all(|angle| angle.abs() <= 360.0);
    match numbers[..] {
        [x, y, z] if good && text.matches(',').count() == 2 => Ok(DVec3::new(x, y, z)),
        _ => Err(format!("'{text}' is not three angles up to 360; write them as 0,0,90")),
    }
}

/// Runs `vizflyt scene convert`.
pub(crate) fn run(args: &ConvertArgs) -> Result<()> {
    let start = Instant::now();
    let mut shown_s = 1;
    // Progress once a second.
    let mut show = |Progress { done, total }: Progress| {
        if start.elapsed().as_secs() >= shown_s {
            shown_s += 1;
            print_line(format!("{} %", done * 100 / total));
        }
    };
    let mut loaded = match args.level {
        0 => format::read_with_progress(&args.from, &mut show)?,
        level => format::read_level(&args.from, level)?,
    };
    print_fmt!(
        "{}: {} splats, degree {}, {} dropped, {:.0} ms",
        loaded.format,
        loaded.splats.len(),
        loaded.splats.sh_degree,
        loaded.dropped.total(),
        start.elapsed().as_secs_f64() * 1e3
    );
    for skipped in loaded.skipped_properties.iter().chain(&loaded.skipped_elements) {
        print_fmt!("skipped: {skipped}");
    }
    args.world_from_scene().apply(&mut loaded.splats);
    let to = Format::of_name(&args.to);
    if loaded.splats.antialiased && to.is_some_and(|format| !format.keeps_antialiased()) {
        print_line(
            "trained with anti-aliasing, which this format cannot store: render with --antialiased on",
        );
    }
    match (args.variant, to) {
        (Some(variant), Some(format)) => {
            let bytes = format::encode_variant(format, variant, &loaded.splats)?;
            std::fs::write(&args.to, bytes)
                .with_context(|| format!("cannot write {}", args.to.display()))
        }
        _ => Ok(format::write(&args.to, &loaded.splats)?),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        convert: ConvertArgs,
    }

    fn moved(options: &str, p: DVec3) -> DVec3 {
        let words = ["x", "a.ply", "b.ply"].into_iter().chain(options.split_whitespace());
        let moved = Cli::try_parse_from(words).unwrap().convert.world_from_scene();
        moved.rotation * p * moved.scale
    }

    #[test]
    fn applies_up_then_rotation_then_scale() {
        let check = |options: &str, p: DVec3, expected: DVec3| {
            let found = moved(options, p);
            assert!((found - expected).length() < 1e-9, "{options}: {found}");
        };
        check("", DVec3::new(1.0, 2.0, 3.0), DVec3::new(1.0, 2.0, 3.0));
        check("--up -y --scale 2", DVec3::NEG_Y, DVec3::Z * 2.0);
        check("--rotate 0,0,90", DVec3::X, DVec3::Y);
        // The rotation about x comes first: y becomes z, which the rotation about z keeps.
        check("--rotate 90,0,90", DVec3::Y, DVec3::Z);
        check("--rotate -90,0,0", DVec3::Y, DVec3::NEG_Z);
        check("--up -y --rotate 0,0,90", DVec3::Z, DVec3::Y);
    }

    #[test]
    fn rejects_invalid_rotations() {
        for wrong in ["90", "0,0", "0,0,x", "0,0,0,0", "0,0,400", "0,0,nan", ""] {
            assert!(degrees(wrong).unwrap_err().contains("0,0,90"), "{wrong}");
        }
    }
}
