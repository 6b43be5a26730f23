//! Layout of TU Munich's RGB-D benchmark (J. Sturm et al., IROS 2012): `rgb/`, `depth/` as 16-bit PNG with 5000 units
//! per metre, lists of both, `accelerometer.txt`, and `groundtruth.txt` of the camera's optical frame.

use std::fmt::Write;

use anyhow::{Context, Result, ensure};
use vizflyt_protocol::geometry::{Cam, Pose, World};

use super::files::{Folder, write_depth, write_rgb};
use super::motion::FlightTracks;
use super::pictures::Pictures;
use super::table::{Row, write_beside};
use super::{Written, seconds_text, write_text};

/// 5000 units per metre.
const UNITS_PER_MM: u16 = 5;

/// Writes the data set of the camera with this name, or of the first one.
pub(super) fn write(
    folder: &Folder,
    motion: &FlightTracks,
    mut pictures: Pictures,
    camera: Option<&str>,
) -> Result<Written> {
    let mut chosen = camera.map(str::to_owned);
    let mut rows: Vec<Row> = Vec::new();
    let (mut rgb, mut depth, mut both) = (list("color images"), list("depth maps"), String::new());
    let mut shown =
        "# camera pose from which each image was rendered: timestamp tx ty tz qx qy qz qw\n"
            .to_owned();
    while let Some(mut image) =
        pictures.next(|image| chosen.as_ref().is_none_or(|name| *name == image.camera))?
    {
        chosen.get_or_insert_with(|| image.camera.clone());
        let size = (image.header.width_px.get(), image.header.height_px.get());
        let at = seconds_text(image.shown_ns);
        let file = format!("rgb/{at}.png");
        write_rgb(&folder.at(&file)?, &pictures.rgb, size)?;
        let _ = writeln!(rgb, "{at} {file}");
        let mut depth_file = String::new();
        if pictures.has_depth() {
            depth_file = format!("depth/{at}.png");
            write_depth(&folder.at(&depth_file)?, &pictures.depth_mm, size, UNITS_PER_MM)?;
            let _ = writeln!(depth, "{at} {depth_file}");
            let _ = writeln!(both, "{at} {file} {at} {depth_file}");
        }
        line(&mut shown, image.shown_ns, &image.header.world_from_cam());
        image.bitstream = Vec::new();
        rows.push(Row { image, file, depth_file });
    }
    ensure!(
        !rows.is_empty(),
        "no image of a camera '{}' can be decoded; without --camera, the first camera is used",
        chosen.unwrap_or_default()
    );
    let body_from_cam = rows.first().context("no image")?.image.header.body_from_cam();
    let mut truth =
        "# ground truth trajectory of the camera\n# timestamp tx ty tz qx qy qz qw\n".to_owned();
    for pose in &motion.poses {
        line(&mut truth, pose.at_ns, &(pose.from_body * body_from_cam));
    }
    let mut accelerometer = "# accelerometer data, body axes\n# timestamp ax ay az\n".to_owned();
    for reading in &motion.imu {
        let a = reading.accel_mps2;
        let _ = writeln!(accelerometer, "{} {} {} {}", seconds_text(reading.at_ns), a.x, a.y, a.z);
    }
    for (name, text) in [
        ("rgb.txt", rgb),
        ("depth.txt", depth),
        ("associations.txt", both),
        ("groundtruth.txt", truth),
        ("groundtruth_images.txt", shown),
        ("accelerometer.txt", accelerometer),
    ] {
        write_text(&folder.at(name)?, &text)?;
    }
    write_beside(folder, motion, &rows)?;
    Ok(Written { images: rows.len(), broken: pictures.broken })
}

fn list(what: &str) -> String {
    format!("# {what}\n# timestamp filename\n")
}

fn line(text: &mut String, at_ns: u64, pose: &Pose<World, Cam>) {
    let (p, q) = (pose.translation_m, pose.rotation);
    let at = seconds_text(at_ns);
    let _ = writeln!(text, "{at} {} {} {} {} {} {} {}", p.x, p.y, p.z, q.x, q.y, q.z, q.w);
}
