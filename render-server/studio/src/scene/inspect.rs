//! `vizflyt scene inspect`: prints the content of a scene file, and warnings about possible problems.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use glam::Vec3;
use serde::Serialize;
use vizflyt_process::print_fmt;
use vizflyt_server::scene::load_as_it_is;
use vizflyt_splat::Splats;
use vizflyt_splat::format::Loaded;

/// Print the content of a scene, and possible problems
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt scene inspect room.ply
  vizflyt scene inspect forest/arena.toml --json")]
pub(crate) struct InspectArgs {
    /// Scene file of any format, or an arena.toml (then its scene)
    scene: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Output of `--json`.
#[derive(Debug, Serialize)]
struct Inspection {
    file: String,
    format: &'static str,
    file_mb: f64,
    splats: usize,
    dropped: usize,
    sh_degree: u8,
    /// Whether the scene was trained with anti-aliasing, according to its file.
    antialiased: bool,
    /// Memory of the loaded scene. [MB]
    memory_mb: f64,
    /// Minimum and maximum of the centres. [scene]
    bounds: [[f32; 3]; 2],
    /// 2nd and 98th percentile of centres of splats at least half opaque. [scene]
    core_bounds: [[f32; 3]; 2],
    opacity: Quantiles,
    /// Largest of the three standard deviations of each splat. [scene]
    scale: Quantiles,
    warnings: Vec<String>,
}

/// Quantiles of a property over all splats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
struct Quantiles {
    min: f32,
    p01: f32,
    p10: f32,
    p50: f32,
    p90: f32,
    p99: f32,
    max: f32,
}

impl Quantiles {
    fn of(mut values: Vec<f32>) -> Self {
        values.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            let index = (share * values.len().saturating_sub(1) as f64).round() as usize;
            values.get(index).copied().unwrap_or_default()
        };
        Self {
            min: at(0.0),
            p01: at(0.01),
            p10: at(0.1),
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            max: at(1.0),
        }
    }

    fn line(&self) -> String {
        let Self { min, p01, p10, p50, p90, p99, max } = self;
        format!("{min:<9.3} {p01:<9.3} {p10:<9.3} {p50:<9.3} {p90:<9.3} {p99:<9.3} {max:.3}")
    }
}

/// Runs `vizflyt scene inspect`.
pub(super) fn run(args: &InspectArgs) -> Result<()> {
    let (path, loaded) = load_as_it_is(&args.scene)?;
    let found = inspect(&path, &loaded);
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&found)?);
        return Ok(());
    }
    let corners = |[min, max]: [[f32; 3]; 2]| {
        let size = Vec3::from(max) - Vec3::from(min);
        format!("{min:.2?} to {max:.2?}, {:.2} x {:.2} x {:.2}", size.x, size.y, size.z)
    };
    print_fmt!("file        {}: {}, {:.1} MB", found.file, found.format, found.file_mb);
    print_fmt!("splats      {}, {} left out", found.splats, found.dropped);
    print_fmt!("harmonics   degree {}", found.sh_degree);
    if found.antialiased {
        print_fmt!("trained     with anti-aliasing, and rendered so");
    }
    print_fmt!("memory      {:.1} MB", found.memory_mb);
    print_fmt!("bounds      {}", corners(found.bounds));
    print_fmt!("core        {}", corners(found.core_bounds));
    print_fmt!("            min       1 %       10 %      50 %      90 %      99 %      max");
    print_fmt!("opacity     {}", found.opacity.line());
    print_fmt!("scale       {}", found.scale.line());
    for warning in &found.warnings {
        print_fmt!("warning     {warning}");
    }
    if found.warnings.is_empty() {
        print_fmt!("nothing looks wrong");
    }
    Ok(())
}

fn inspect(path: &Path, loaded: &Loaded) -> Inspection {
    let splats = &loaded.splats;
    let bounds = bounds(splats.means_m.iter().copied(), 0.0);
    let solid = splats.means_m.iter().zip(&splats.opacities);
    let solid: Vec<Vec3> =
        solid.filter(|(_, opacity)| **opacity >= 0.5).map(|(mean, _)| *mean).collect();
    let core = if solid.is_empty() { &splats.means_m } else { &solid };
    let core_bounds = self::bounds(core.iter().copied(), EDGE);
    let scale = Quantiles::of(splats.scales_m.iter().map(|s| s.max_element()).collect());
    let opacity = Quantiles::of(splats.opacities.clone());
    let mut warnings = warnings_of_file(loaded);
    warnings.extend(warnings_of_splats(splats, core_bounds));
    Inspection {
        file: path.display().to_string(),
        format: loaded.format.name(),
        file_mb: bytes_on_disk(path) as f64 / 1e6,
        splats: splats.len(),
        dropped: loaded.dropped.total(),
        sh_degree: splats.sh_degree,
        antialiased: splats.antialiased,
        memory_mb: memory_bytes(splats) as f64 / 1e6,
        bounds: bounds.map(|corner| corner.to_array()),
        core_bounds: core_bounds.map(|corner| corner.to_array()),
        opacity,
        scale,
        warnings,
    }
}

/// Returns the size of a file, or of all files directly in a folder. [bytes]
fn bytes_on_disk(path: &Path) -> u64 {
    let size = |path: &Path| std::fs::metadata(path).map_or(0, |data| data.len());
    match std::fs::read_dir(path) {
        Ok(entries) => entries.filter_map(Result::ok).map(|entry| size(&entry.path())).sum(),
        Err(_) => size(path),
    }
}

fn memory_bytes(splats: &Splats) -> usize {
    size_of_val(&splats.means_m[..])
        + size_of_val(&splats.scales_m[..])
        + size_of_val(&splats.rotations[..])
        + size_of_val(&splats.opacities[..])
        + size_of_val(&splats.sh[..])
}

/// Returns the corners of a box around all points, without a share `edge` at both ends of each axis.
fn bounds(points: impl Iterator<Item = Vec3>, edge: f64) -> [Vec3; 2] {
    let mut points: Vec<Vec3> = points.collect();
    let mut corners = [Vec3::ZERO; 2];
    if points.is_empty() {
        return corners;
    }
    for axis in 0..3 {
        points.sort_unstable_by(|a, b| a[axis].total_cmp(&b[axis]));
        for (corner, share) in corners.iter_mut().zip([edge, 1.0 - edge]) {
            corner[axis] = points[(share * (points.len() - 1) as f64).round() as usize][axis];
        }
    }
    corners
}

fn warnings_of_file(loaded: &Loaded) -> Vec<String> {
    let mut warnings = Vec::new();
    let dropped = loaded.dropped;
    for (count, what) in [
        (dropped.non_finite, "hold numbers that are not finite: the training diverged there"),
        (dropped.zero_rotation, "have no rotation (a zero quaternion)"),
        (dropped.scale_overflow, "have an infinite size"),
    ] {
        if count > 0 {
            warnings.push(format!("{count} splats {what}; they are skipped"));
        }
    }
    // Trainers write normals of zero, which need no warning.
    let is_normal = |name: &&String| ["nx", "ny", "nz"].contains(&name.as_str());
    let names: Vec<_> = loaded.skipped_properties.iter().filter(|name| !is_normal(name)).collect();
    if !names.is_empty() {
        let names = names.iter().map(|name| name.as_str()).collect::<Vec<_>>().join(", ");
        warnings.push(format!("unused properties are ignored: {names}"));
    }
    warnings
}

fn warnings_of_splats(splats: &Splats, [low, high]: [Vec3; 2]) -> Vec<String> {
    let mut warnings = Vec::new();
    let (count, size) = (splats.len() as f64, high - low);
    let share = |found: usize| 100.0 * found as f64 / count;
    let visible = splats.opacities.iter().filter(|&&opacity| opacity >= 1.0 / 255.0).count();
    let opaque = splats.opacities.iter().filter(|&&opacity| opacity >= 0.5).count();
    if visible == 0 {
        warnings.push(
            "every splat is fully transparent: images will be empty; was the opacity exported \
             without its logit?"
                .to_owned(),
        );
    } else if share(opaque) < 1.0 {
        warnings.push(format!(
            "only {:.1} % of the splats are at least half opaque: surfaces will look like fog, and \
             depth will have holes",
            share(opaque)
        ));
    } else if share(visible) < 50.0 {
        warnings.push(format!(
            "{:.0} % of the splats are too faint to be seen; prune them and the scene renders as \
             fast with less memory",
            100.0 - share(visible)
        ));
    }
    let huge = splats.scales_m.iter().filter(|s| s.max_element() > 0.5 * size.max_element());
    let huge = huge.count();
    if size.max_element() > 0.0 && huge > 0 {
        warnings.push(format!(
            "{huge} splats are more than half as large as the scene's core ({:.2}): sky, or haze \
             that hides the camera",
            size.max_element()
        ));
    }
    let (middle, reach) = ((low + high) / 2.0, 2.0 * size.max_element());
    let far = splats.means_m.iter().filter(|m| (**m - middle).abs().max_element() > reach).count();
    if size.max_element() > 0.0 && far > 0 {
        warnings.push(format!(
            "{far} splats ({:.1} %) float more than twice the core's size away from its middle: \
             background, or floaters to be cropped",
            share(far)
        ));
    }
    let needle = |s: &&Vec3| {
        let mut sides = s.to_array();
        sides.sort_unstable_by(f32::total_cmp);
        sides[2] > NEEDLE * sides[1] && sides[2] > 0.0
    };
    let needles = splats.scales_m.iter().filter(needle).count();
    if share(needles) >= 1.0 {
        warnings.push(format!(
            "{:.0} % of the splats are needles, {NEEDLE:.0} times longer than wide: spikes at new \
             angles; train with a limit on anisotropy",
            share(needles)
        ));
    }
    let extent = size.max_element();
    if !(MIN_EXTENT..=MAX_EXTENT).contains(&extent) {
        warnings.push(format!(
            "the core is {extent:.3} units wide: the unit is hardly a metre; \
             `vizflyt serve` takes --scale METRES_PER_UNIT"
        ));
    }
    warnings
}

/// Share of splats outside the core at each end of an axis.
const EDGE: f64 = 0.02;
/// Minimum ratio of length to width of a needle; trained scenes have few.
const NEEDLE: f32 = 50.0;
/// Plausible range of a scene's size: from a table top to a campus. [m]
const MIN_EXTENT: f32 = 1.0;
const MAX_EXTENT: f32 = 500.0;

#[cfg(test)]
mod tests {
    use glam::Quat;

    use super::*;

    /// Returns 101 balls on a line of 10 m.
    fn balls() -> Splats {
        let count = 101;
        Splats {
            means_m: (0..count).map(|k| Vec3::X * (k as f32 * 0.1)).collect(),
            scales_m: vec![Vec3::splat(0.1); count],
            rotations: vec![Quat::IDENTITY; count],
            opacities: vec![0.9; count],
            sh_degree: 0,
            sh: vec![0.0; count * 3],
            antialiased: false,
        }
    }

    fn warnings(change: impl FnOnce(&mut Splats)) -> String {
        let mut splats = balls();
        change(&mut splats);
        let core = bounds(splats.means_m.iter().copied(), EDGE);
        warnings_of_splats(&splats, core).join("\n")
    }

    #[test]
    fn gives_no_warnings_for_a_good_scene() {
        assert_eq!(warnings(|_| ()), "");
    }

    #[test]
    fn warns_about_each_fault() {
        let check = |change: fn(&mut Splats), expected: &str| {
            let found = warnings(change);
            assert!(found.contains(expected), "'{found}' lacks '{expected}'");
        };
        check(|s| s.opacities.fill(0.0), "every splat is fully transparent");
        check(|s| s.opacities.fill(0.2), "only 0.0 % of the splats are at least half opaque");
        check(|s| s.opacities[..60].fill(0.0), "59 % of the splats are too faint");
        check(|s| s.scales_m[3] = Vec3::splat(9.0), "1 splats are more than half as large");
        check(|s| s.means_m[100] = Vec3::Y * 900.0, "1 splats (1.0 %) float");
        check(|s| s.scales_m.fill(Vec3::new(0.001, 0.002, 0.3)), "100 % of the splats are needles");
        check(|s| s.means_m.iter_mut().for_each(|m| *m *= 0.01), "the unit is hardly a metre");
        check(|s| s.means_m.iter_mut().for_each(|m| *m *= 1e3), "the unit is hardly a metre");
    }

    #[test]
    fn computes_quantiles() {
        let found = Quantiles::of((0..=100).rev().map(|k| k as f32).collect());
        assert_eq!(
            (found.min, found.p01, found.p50, found.p99, found.max),
            (0.0, 1.0, 50.0, 99.0, 100.0)
        );
        assert_eq!(Quantiles::of(Vec::new()), Quantiles::default());
    }
}
