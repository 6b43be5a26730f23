//! `vizflyt scene align`: where a captured scene lies in the room, written into its arena.toml, and whether that is known
//! well enough to fly by.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail, ensure};
use clap::{ArgGroup, Args};
use glam::DVec3;
use toml_edit::{Array, DocumentMut, InlineTable, Item, Value, value};
use vizflyt_arena::ArenaConfig;
use vizflyt_tags::detect::{Detector, DetectorSettings};
use vizflyt_tags::image::Gray;
use vizflyt_tags::layout::{LayoutFrame, Tag, TagLayout};
use vizflyt_twin::Dataset;
use vizflyt_twin::align::corners::{self, Ray};
use vizflyt_twin::align::floor::{self, Floor};
use vizflyt_twin::align::points::{self, Pair};
use vizflyt_twin::align::{Fit, Similarity};
use vizflyt_twin::dataset::Photo;

use crate::terminal::print_fmt;

/// Finds how a captured scene lies in the room, and writes it into `[scene]` of its arena.toml.
#[derive(Args, Debug)]
#[command(
    group(ArgGroup::new("by").required(true).args(["tags", "floor"])),
    after_help = "Examples:
  vizflyt scene align my-hall --tags mat.toml --capture my-capture
  vizflyt scene align my-hall --floor 0.1,1.2,3.3 --floor 2.0,1.1,3.1 --floor 0.3,1.2,5.0 \\
      --above 0,-1,3 --length 0.1,1.2,3.3:0.1,-0.4,3.3=2.0

--capture is what the scene was trained from: a folder of COLMAP, or of nerfstudio (transforms.json).
Points are in the scene file's own axes and units."
)]
pub(crate) struct AlignArgs {
    /// An arena around a scene file, as `vizflyt arena new` makes one
    arena: PathBuf,
    /// Layout of printed tags that stand in the capture, surveyed in the room (`vizflyt tags print`)
    #[arg(long, value_name = "LAYOUT", requires = "capture")]
    tags: Option<PathBuf>,
    /// The photos and their poses that the scene was trained from
    #[arg(long, value_name = "DATASET")]
    capture: Option<PathBuf>,
    /// A point of the floor; three or more. The first becomes the origin, the second lies on the x axis
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true, requires_all = ["above", "length"])]
    floor: Vec<DVec3>,
    /// A point above the floor
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    above: Option<DVec3>,
    /// Two points, and how far apart they are in the room [m]
    #[arg(long, value_name = "P:P=METRES", value_parser = length, allow_hyphen_values = true)]
    length: Option<([DVec3; 2], f64)>,
    /// How well points were picked, or tags surveyed, one sigma [mm]
    #[arg(long, value_name = "MM", default_value_t = 5.0)]
    sigma_mm: f64,
    /// What the twin may be off within the fence, at most [m]
    #[arg(long, value_name = "METRES", default_value_t = 0.1)]
    allow_m: f64,
    /// Writes the place even where it is not known well enough
    #[arg(long)]
    force: bool,
}

/// Runs `vizflyt scene align`.
pub(crate) fn run(args: &AlignArgs) -> Result<ExitCode> {
    let path = arena_file(&args.arena)?;
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let arena = ArenaConfig::parse(&text).with_context(|| path.display().to_string())?;
    let sigma_m = args.sigma_mm * 1e-3;
    let fit = match (&args.tags, &args.capture, &args.above, &args.length) {
        (Some(layout), Some(capture), ..) => by_tags(layout, capture, sigma_m)?,
        (None, _, Some(above), Some((ends, length_m))) => floor::fit(&Floor {
            points: args.floor.clone(),
            above: *above,
            length: *ends,
            length_m: *length_m,
            length_sigma_m: LENGTH_SHARE * length_m,
            click_sigma_m: sigma_m,
        })?,
        _ => bail!("give --tags with --capture, or --floor with --above and --length"),
    };
    let fence = &arena.geofence;
    let bound_m = fit.bound_within_m(fence.min_m, fence.max_m);
    print(&fit, bound_m);
    let is_known = bound_m <= args.allow_m;
    if is_known {
        print_fmt!(
            "go          within the fence the twin is off by at most {:.1} cm",
            bound_m * 1e2
        );
    } else {
        print_fmt!(
            "NO GO       within the fence the twin may be off by {:.1} cm; {:.1} are allowed (--allow-m): use points \
             farther apart, more tags, or a smaller fence",
            bound_m * 1e2,
            args.allow_m * 1e2
        );
    }
    if !(is_known || args.force) {
        print_fmt!("unchanged   {}", path.display());
        return Ok(ExitCode::FAILURE);
    }
    let placed = with_place(&text, &arena.scene.file, &fit.world_from_scene)?;
    ArenaConfig::parse(&placed).context("the arena would not be read again")?;
    std::fs::write(&path, placed).with_context(|| format!("cannot write {}", path.display()))?;
    print_fmt!("written     {}", path.display());
    print_fmt!("next        vizflyt arena check {}", args.arena.display());
    Ok(ExitCode::SUCCESS)
}

fn arena_file(arena: &Path) -> Result<PathBuf> {
    let path = if arena.is_dir() { arena.join("arena.toml") } else { arena.to_owned() };
    ensure!(
        path.extension().is_some_and(|extension| extension == "toml") && path.is_file(),
        "{} is no arena; make one around the scene: vizflyt arena new FOLDER --scene {}",
        arena.display(),
        arena.display()
    );
    Ok(path)
}

fn print(fit: &Fit, bound_m: f64) {
    let Similarity { scale, rotation, translation_m } = fit.world_from_scene;
    let [x, y, z, w] = rotation.to_array();
    print_fmt!("scale       {scale:.6} m per unit, to {:.2} %", 3e2 * fit.scale_sigma);
    print_fmt!("rotation    {x:.5}, {y:.5}, {z:.5}, {w:.5} (x, y, z, w)");
    print_fmt!(
        "tilt        to {:.2} degrees, heading to {:.2}",
        3.0 * fit.tilt_sigma_rad.to_degrees(),
        3.0 * fit.yaw_sigma_rad.to_degrees()
    );
    let p_m = translation_m;
    print_fmt!("origin      {:.3}, {:.3}, {:.3} m", p_m.x, p_m.y, p_m.z);
    print_fmt!(
        "residual    {:.2} cm rms, {:.2} cm at worst, over {} points; {} left out",
        fit.rms_m * 1e2,
        fit.worst_m * 1e2,
        fit.used,
        fit.left_out
    );
    print_fmt!("bound       {:.1} cm within the fence, at three sigmas", bound_m * 1e2);
}

/// Finds the place by tags that the photos show.
fn by_tags(layout_path: &Path, capture: &Path, sigma_m: f64) -> Result<Fit> {
    let layout = TagLayout::read(layout_path)?;
    if layout.frame != LayoutFrame::World {
        print_fmt!(
            "note        {} is not in the world frame: its own becomes the world's",
            layout_path.display()
        );
    }
    let dataset = Dataset::read(capture, None)?;
    let mut families: Vec<_> = layout.tags.iter().map(|tag| tag.family).collect();
    families.dedup();
    let mut detector = Detector::new(&families, DetectorSettings::default());
    // Of each tag of the layout, what sees each of its corners.
    let mut sights: Vec<[Vec<Ray>; 4]> = layout.tags.iter().map(|_| Default::default()).collect();
    let mut with_tags = 0;
    for photo in &dataset.photos {
        let seen = rays(photo, &layout.tags, &mut detector)?;
        with_tags += usize::from(!seen.is_empty());
        for (tag, rays) in seen {
            for (corner, ray) in sights[tag].iter_mut().zip(rays) {
                corner.push(ray);
            }
        }
    }
    let mut pairs = Vec::new();
    let mut tags = 0;
    for (tag, sights) in layout.tags.iter().zip(&sights) {
        let before = pairs.len();
        for (world_m, rays) in tag.corners_m().into_iter().zip(sights) {
            if let Some(corner) = corners::meet(rays) {
                pairs.push(Pair { scene: corner.position, world_m });
            }
        }
        tags += usize::from(pairs.len() > before);
    }
    print_fmt!(
        "seen        {tags} of {} tags from two places or more, in {with_tags} of {} photos",
        layout.tags.len(),
        dataset.photos.len()
    );
    ensure!(
        tags > 0,
        "no tag of {} is seen from two places in {}; are the photos sharp, and is it the layout of these tags?",
        layout_path.display(),
        capture.display()
    );
    Ok(points::fit(&pairs, sigma_m)?)
}

/// Returns the tags in a photo, by their index, with the lines of sight to their corners.
fn rays(photo: &Photo, tags: &[Tag], detector: &mut Detector) -> Result<Vec<(usize, [Ray; 4])>> {
    let target = &photo.target;
    // ITU-R BT.601.
    let grey = |rgb: &[u8]| {
        let sum = 299 * u32::from(rgb[0]) + 587 * u32::from(rgb[1]) + 114 * u32::from(rgb[2]);
        (sum / 1000) as u8
    };
    let pixels = target.rgb.chunks_exact(3).map(grey).collect();
    let image = Gray::new(target.width as u32, target.height as u32, pixels)
        .with_context(|| format!("{}: an image without pixels", photo.name))?;
    let found = detector.search(&image, &photo.view.intrinsics(), true);
    let view = &photo.view;
    let origin = view.position.as_dvec3();
    let ray = |px: glam::DVec2| {
        let towards = view.unproject([px.x as f32, px.y as f32], 1.0).as_dvec3() - origin;
        Ray { origin, direction: towards.normalize() }
    };
    Ok(found
        .iter()
        .filter_map(|seen| {
            let is_it = |tag: &Tag| tag.family == seen.family && tag.id == seen.id;
            Some((tags.iter().position(is_it)?, seen.corners_px.map(ray)))
        })
        .collect())
}

/// Returns the text of an arena.toml with another place of its scene; all else stays, comments too.
fn with_place(text: &str, file: &str, place: &Similarity) -> Result<String> {
    let mut document: DocumentMut = text.parse()?;
    let numbers = |of: &[f64]| Value::Array(of.iter().copied().collect::<Array>());
    let rotation = numbers(&place.rotation.to_array());
    let origin = numbers(&place.translation_m.to_array());
    let old = document.get("scene");
    let crop = old.and_then(|scene| scene.get("crop")).cloned();
    if let Some(table) = document.get_mut("scene").and_then(Item::as_table_mut) {
        for key in ["up", "yaw_deg"] {
            table.remove(key);
        }
        table.insert("rotation", value(rotation));
        table.insert("metres_per_unit", value(place.scale));
        table.insert("origin", value(origin));
    } else {
        // The short form is a line before any table, and becomes a line there.
        let mut table = InlineTable::new();
        table.insert("file", file.into());
        table.insert("rotation", rotation);
        table.insert("metres_per_unit", place.scale.into());
        table.insert("origin", origin);
        if let Some(crop) = crop.and_then(|crop| crop.into_value().ok()) {
            table.insert("crop", crop);
        }
        document.insert("scene", value(table));
    }
    Ok(document.to_string())
}

fn point(text: &str) -> Result<DVec3, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z]) if DVec3::new(x, y, z).is_finite() => Ok(DVec3::new(x, y, z)),
        _ => Err(format!("'{text}' is no point; write it as 0.1,-2,3.5")),
    }
}

fn length(text: &str) -> Result<([DVec3; 2], f64), String> {
    let wrong = || format!("'{text}' is no known length; write it as 0,1,2:0,1,4=2.0");
    let (ends, metres) = text.split_once('=').ok_or_else(wrong)?;
    let (from, to) = ends.split_once(':').ok_or_else(wrong)?;
    let metres: f64 = metres.trim().parse().map_err(|_| wrong())?;
    if !(metres > 0.0 && metres.is_finite()) {
        return Err(wrong());
    }
    Ok(([point(from)?, point(to)?], metres))
}

/// A tape measure, laid by hand.
const LENGTH_SHARE: f64 = 0.001;

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    const PLACE: Similarity = Similarity {
        scale: 0.25,
        rotation: DQuat::from_xyzw(0.6, 0.0, 0.0, 0.8),
        translation_m: DVec3::new(1.0, -2.0, 0.5),
    };

    #[test]
    fn a_place_is_written_and_all_else_stays() {
        let rest = "\n# The net.\n[geofence]\nmin_m = [0, 0, 0]   # west\nmax_m = [9, 4, 3]\n";
        for scene in [
            "scene = \"room.ply\" # captured\n",
            "[scene]\nfile = \"room.ply\"\nup = \"-y\"\nyaw_deg = 4.0\n",
        ] {
            // A table of its own comes after the lines of the root.
            let text = format!("name = \"hall\"\n{scene}{rest}");
            let placed = with_place(&text, "room.ply", &PLACE).unwrap();
            assert!(placed.contains(rest), "{placed}");
            let read: toml_edit::DocumentMut = placed.parse().unwrap();
            let scene = &read["scene"];
            assert_eq!(scene["file"].as_str(), Some("room.ply"));
            assert_eq!(scene["metres_per_unit"].as_float(), Some(0.25));
            assert!(scene.get("up").is_none() && scene.get("yaw_deg").is_none(), "{placed}");
            let origin: Vec<_> = scene["origin"].as_array().unwrap().iter().collect();
            assert_eq!(origin[1].as_float(), Some(-2.0));
        }
    }

    #[test]
    fn points_and_lengths_are_read() {
        assert_eq!(point("1, -2,3.5"), Ok(DVec3::new(1.0, -2.0, 3.5)));
        assert_eq!(length("0,0,0:0,0,4=2.5"), Ok(([DVec3::ZERO, DVec3::Z * 4.0], 2.5)));
        for wrong in ["1,2", "1,2,x", "1,2,inf", ""] {
            assert!(point(wrong).is_err(), "{wrong}");
        }
        for wrong in ["0,0,0:0,0,4", "0,0,0=2", "0,0,0:0,0,4=-1", "0,0,0:0,0=1"] {
            assert!(length(wrong).is_err(), "{wrong}");
        }
    }
}
