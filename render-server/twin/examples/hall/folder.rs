//! Writes a capture as a COLMAP folder in text form.

use std::fmt::Write;
use std::io;
use std::path::Path;

use crate::capture::Capture;

/// Writes images/ and sparse/0/.
pub(crate) fn write(capture: &Capture, folder: &Path) -> io::Result<()> {
    let (images, sparse) = (folder.join("images"), folder.join("sparse/0"));
    std::fs::create_dir_all(&images)?;
    std::fs::create_dir_all(&sparse)?;
    let k = &capture.intrinsics;
    let camera = format!(
        "1 PINHOLE {} {} {} {} {} {}\n",
        k.width_px, k.height_px, k.fx_px, k.fy_px, k.cx_px, k.cy_px
    );
    std::fs::write(sparse.join("cameras.txt"), camera)?;

    let mut seen = vec![Vec::new(); capture.photos.len()];
    let mut points = String::new();
    for (id, point) in capture.points.iter().enumerate() {
        let [x, y, z] = point.p_world_m.to_array();
        let [r, g, b] = point.rgb;
        let _ = write!(points, "{} {x} {y} {z} {r} {g} {b} 0.5", id + 1);
        for &(photo, pixel) in &point.seen {
            let _ = write!(points, " {} {}", photo + 1, seen[photo].len());
            seen[photo].push((pixel, id + 1));
        }
        points.push('\n');
    }
    std::fs::write(sparse.join("points3D.txt"), points)?;

    let mut text = String::new();
    for (i, photo) in capture.photos.iter().enumerate() {
        let cam_from_world = photo.world_from_cam.inverse();
        let [x, y, z, w] = cam_from_world.rotation.to_array();
        let [tx, ty, tz] = cam_from_world.translation_m.to_array();
        let _ = writeln!(text, "{} {w} {x} {y} {z} {tx} {ty} {tz} 1 {i:03}.png", i + 1);
        let pixels: Vec<String> =
            seen[i].iter().map(|([u, v], id)| format!("{u} {v} {id}")).collect();
        let _ = writeln!(text, "{}", pixels.join(" "));
        image::save_buffer(
            images.join(format!("{i:03}.png")),
            &photo.rgb,
            k.width_px,
            k.height_px,
            image::ExtendedColorType::Rgb8,
        )
        .map_err(io::Error::other)?;
    }
    std::fs::write(sparse.join("images.txt"), text)
}
