//! Writes a model as cameras.txt, images.txt and points3D.txt, which all tools for COLMAP read.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use vizflyt_protocol::geometry::Intrinsics;

use super::parameters;
use crate::dataset::error::DatasetError;
use crate::dataset::sparse::SparseModel;

/// Writes a model into a folder, which is created if missing. Images are numbered in their order, from 1.
///
/// # Errors
/// [`DatasetError::Io`] if a file cannot be written.
pub fn write(folder: &Path, model: &SparseModel) -> Result<(), DatasetError> {
    let mut lenses: Vec<Intrinsics> = Vec::new();
    let mut images = String::from(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# X, Y, POINT3D_ID\n",
    );
    // Track of each point: image number and index of the observation in the image.
    let mut tracks: BTreeMap<u64, String> = BTreeMap::new();
    for (number, image) in (1..).zip(&model.images) {
        let known = lenses.iter().position(|lens| *lens == image.intrinsics);
        let camera = known.unwrap_or_else(|| {
            lenses.push(image.intrinsics);
            lenses.len() - 1
        }) + 1;
        let cam_from_world = image.world_from_cam.inverse();
        let ([x, y, z, w], t) = (cam_from_world.rotation.to_array(), cam_from_world.translation_m);
        // Writing to a string does not fail.
        let _ = writeln!(
            images,
            "{number} {w} {x} {y} {z} {} {} {} {camera} {}",
            t.x, t.y, t.z, image.name
        );
        for (index, seen) in image.seen.iter().enumerate() {
            let _ = write!(images, "{} {} {} ", seen.pixel.x, seen.pixel.y, seen.point);
            let _ = write!(tracks.entry(seen.point).or_default(), " {number} {index}");
        }
        images.push('\n');
    }
    let mut cameras = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMETERS\n");
    for (number, lens) in (1..).zip(&lenses) {
        let (model, numbers) = parameters(lens);
        let _ = write!(cameras, "{number} {model} {} {}", lens.width_px, lens.height_px);
        for value in numbers {
            let _ = write!(cameras, " {value}");
        }
        cameras.push('\n');
    }
    let mut points =
        String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK as IMAGE_ID, POINT2D_INDEX\n");
    let sorted: BTreeMap<_, _> = model.points.iter().collect();
    for (id, point) in sorted {
        let (p, [r, g, b]) = (point.position, point.rgb);
        let track = tracks.get(id).map_or("", String::as_str);
        // The reprojection error is not stored; 0 is valid in the format.
        let _ = writeln!(points, "{id} {} {} {} {r} {g} {b} 0{track}", p.x, p.y, p.z);
    }
    let io = |path: &Path| {
        let path = path.to_owned();
        move |cause| DatasetError::Io { path, cause }
    };
    std::fs::create_dir_all(folder).map_err(io(folder))?;
    for (name, text) in [("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", points)]
    {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(io(&path))?;
    }
    Ok(())
}
