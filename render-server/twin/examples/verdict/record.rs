//! Thins a capture for the repository: COLMAP's text with the points that most images saw, and the other input of a
//! verdict.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

use serde_json::json;
use vizflyt_protocol::geometry::Distortion;
use vizflyt_twin::adjust::Capture;

use crate::truth::Truth;

/// Writes cameras.txt, images.txt, points3D.txt and walk.json.
pub(crate) fn record(
    folder: &Path,
    capture: &Capture,
    truth: &Truth,
) -> Result<(), Box<dyn std::error::Error>> {
    std::fs::create_dir_all(folder)?;
    let lens = &capture.lens;
    let (k1, k2) = match lens.distortion {
        Distortion::BrownConrady { k1, k2, .. } => (k1, k2),
        _ => (0.0, 0.0),
    };
    let camera = format!(
        "1 RADIAL {} {} {:.4} {:.2} {:.2} {k1:.6} {k2:.6}\n",
        lens.width_px, lens.height_px, lens.fx_px, lens.cx_px, lens.cy_px
    );
    std::fs::write(folder.join("cameras.txt"), camera)?;

    let mut views: BTreeMap<usize, usize> = BTreeMap::new();
    for seen in capture.images.iter().flat_map(|image| &image.seen) {
        *views.entry(seen.point).or_default() += 1;
    }
    let mut kept = BTreeSet::new();
    for image in &capture.images {
        let mut best: Vec<usize> = image.seen.iter().map(|seen| seen.point).collect();
        best.sort_by_key(|point| (std::cmp::Reverse(views[point]), *point));
        kept.extend(best.into_iter().take(PER_IMAGE));
    }
    let mut images = String::new();
    for (id, image) in capture.images.iter().enumerate() {
        let cam_from_scene = image.scene_from_cam.inverse();
        let ([x, y, z, w], t) = (cam_from_scene.rotation.to_array(), cam_from_scene.translation_m);
        let name = &image.name;
        writeln!(
            images,
            "{} {w:.7} {x:.7} {y:.7} {z:.7} {:.5} {:.5} {:.5} 1 {name}",
            id + 1,
            t.x,
            t.y,
            t.z
        )?;
        let seen = image.seen.iter().filter(|seen| kept.contains(&seen.point));
        let words: Vec<String> =
            seen.map(|s| format!("{:.1} {:.1} {}", s.pixel.x, s.pixel.y, s.point)).collect();
        writeln!(images, "{}", words.join(" "))?;
    }
    std::fs::write(folder.join("images.txt"), images)?;
    let mut points = String::new();
    for &point in &kept {
        let p = capture.points[point];
        writeln!(points, "{point} {:.4} {:.4} {:.4} 128 128 128 0", p.x, p.y, p.z)?;
    }
    std::fs::write(folder.join("points3D.txt"), points)?;

    let tags: Vec<_> = capture
        .tags
        .iter()
        .map(|tag| json!({ "name": tag.name, "size_m": tag.size_m, "corners_m": tag.corners_m }))
        .collect();
    let sightings: Vec<_> = capture
        .images
        .iter()
        .flat_map(|image| image.tags.iter().map(move |seen| (image, seen)))
        .map(|(image, seen)| {
            let px = seen.corners_px.map(|corner| [tenth(corner.x), tenth(corner.y)]);
            json!({ "image": image.name, "tag": seen.tag, "corners_px": px })
        })
        .collect();
    let given: Vec<_> = truth
        .images
        .iter()
        .map(|image| json!({ "name": image.name, "at_s": image.at_s, "truth_m": image.position_m() }))
        .collect();
    let walk = json!({ "given": given, "tags": tags, "sightings": sightings });
    std::fs::write(folder.join("walk.json"), serde_json::to_string(&walk)?)?;
    Ok(())
}

/// Rounds to 0.01 px; corners are less accurate than this.
fn tenth(x: f64) -> f64 {
    (x * 100.0).round() / 100.0
}

/// Number of points per image: enough for a pose and for connected parts.
const PER_IMAGE: usize = 40;
