//! Tables of a flight: images, poses, IMU, setpoints, the plugin's odometry. The layouts of EuRoC and TUM lack some of
//! them, which are written as additional CSV files.

use anyhow::Result;
use vizflyt_runtime::log::data::FlightImage;

use super::columns::Table;
use super::files::{Folder, write_depth, write_rgb};
use super::motion::{FlightTracks, Interpolated};
use super::pictures::Pictures;
use super::{Written, parquet, seconds_text, write_text};

/// Written image and its files.
#[derive(Debug)]
pub(super) struct Row {
    pub(super) image: FlightImage,
    pub(super) file: String,
    pub(super) depth_file: String,
}

/// Writes Parquet files and images.
pub(super) fn write(
    folder: &Folder,
    motion: &FlightTracks,
    mut pictures: Pictures,
) -> Result<Written> {
    let mut rows = Vec::new();
    while let Some(mut image) = pictures.next(|_| true)? {
        let size = (image.header.width_px.get(), image.header.height_px.get());
        let (camera, at_ns) = (file_name(&image.camera), image.shown_ns);
        let file = format!("images/{camera}/{at_ns}.png");
        write_rgb(&folder.at(&file)?, &pictures.rgb, size)?;
        let mut depth_file = String::new();
        if pictures.has_depth() {
            depth_file = format!("depth/{camera}/{at_ns}.png");
            write_depth(&folder.at(&depth_file)?, &pictures.depth_mm, size, 1)?;
        }
        image.bitstream = Vec::new();
        rows.push(Row { image, file, depth_file });
    }
    let tables = [
        ("images", images(motion, &rows)),
        ("poses", poses(motion)),
        ("imu", imu(motion)),
        ("setpoints_asked", asked(motion)),
        ("setpoints_sent", sent(motion)),
        ("odometry", odometry(motion)),
    ];
    for (name, table) in tables {
        let path = folder.at(&format!("{name}.parquet"))?;
        std::fs::write(&path, parquet::encode(&table))?;
    }
    Ok(Written { images: rows.len(), broken: pictures.broken })
}

/// Writes the tables that the layouts of EuRoC and TUM lack.
pub(super) fn write_beside(folder: &Folder, motion: &FlightTracks, rows: &[Row]) -> Result<()> {
    for (name, table) in [
        ("images.csv", images(motion, rows)),
        ("setpoints_asked.csv", asked(motion)),
        ("setpoints_sent.csv", sent(motion)),
    ] {
        write_text(&folder.at(name)?, &table.to_csv())?;
    }
    if motion.odometry.is_empty() {
        return Ok(());
    }
    let line = |pose: &vizflyt_runtime::log::data::StampedPose<_>| {
        let (p, q) = (pose.from_body.translation_m, pose.from_body.rotation);
        let at = seconds_text(pose.at_ns);
        format!("{at} {} {} {} {} {} {} {}\n", p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    };
    let text: String = motion.odometry.iter().map(line).collect();
    write_text(&folder.at("odometry.tum")?, &text)
}

/// Returns the name of a camera with only characters that are safe in a path.
pub(super) fn file_name(camera: &str) -> String {
    let safe = |letter: char| {
        if letter.is_ascii_alphanumeric() || "-_".contains(letter) { letter } else { '_' }
    };
    camera.chars().map(safe).collect()
}

fn images(motion: &FlightTracks, rows: &[Row]) -> Table {
    let mut table = Table::default();
    let all = || rows.iter().map(|row| &row.image);
    table.integers("timestamp_ns", all().map(|image| image.shown_ns));
    table.texts("camera", all().map(|image| image.camera.clone()));
    table.texts("file", rows.iter().map(|row| row.file.clone()));
    table.texts("depth_file", rows.iter().map(|row| row.depth_file.clone()));
    table.integers("observation", all().map(|image| image.seq));
    table.integers("pose_stamp_ns", all().map(|image| image.pose_ns));
    table.integers("received_ns", all().map(|image| image.received_ns));
    table.integers("width_px", all().map(|image| image.header.width_px.get().into()));
    table.integers("height_px", all().map(|image| image.header.height_px.get().into()));
    let k = || all().map(|image| image.header.intrinsics());
    table.numbers("fx_px", k().map(|k| k.fx_px));
    table.numbers("fy_px", k().map(|k| k.fy_px));
    // OpenCV's convention: the centre of the first pixel is 0.
    table.numbers("cx_px", k().map(|k| k.cx_px - 0.5));
    table.numbers("cy_px", k().map(|k| k.cy_px - 0.5));
    let mount = || all().map(|image| image.header.body_from_cam());
    table.vectors("body_from_cam", mount().map(|pose| Some(pose.translation_m)));
    table.rotations("body_from_cam", mount().map(|pose| Some(pose.rotation)));
    let shown = || all().map(|image| image.header.world_from_body());
    table.vectors("pose_at_image", shown().map(|pose| Some(pose.translation_m)));
    table.rotations("pose_at_image", shown().map(|pose| Some(pose.rotation)));
    let filtered: Vec<Option<Interpolated>> =
        all().map(|image| motion.at(image.shown_ns)).collect();
    let filtered = || filtered.iter();
    table.vectors("pose", filtered().map(|at| Some(at.as_ref()?.world_from_body.translation_m)));
    table.rotations("pose", filtered().map(|at| Some(at.as_ref()?.world_from_body.rotation)));
    table.vectors("position_sigma", filtered().map(|at| Some(at.as_ref()?.position_sigma_m)));
    table.vectors("rotation_sigma", filtered().map(|at| Some(at.as_ref()?.rotation_sigma_rad)));
    table
}

fn poses(motion: &FlightTracks) -> Table {
    let mut table = Table::default();
    table.integers("timestamp_ns", motion.poses.iter().map(|pose| pose.at_ns));
    table.vectors("p", motion.poses.iter().map(|pose| Some(pose.from_body.translation_m)));
    table.rotations("q", motion.poses.iter().map(|pose| Some(pose.from_body.rotation)));
    let motions = motion.poses.iter().map(|pose| motion.motion_at(pose.at_ns));
    table.vectors("v", motions.clone().map(|one| Some(one.v_world_mps)));
    table.vectors("position_sigma", motions.clone().map(|one| Some(one.position_sigma_m)));
    table.vectors("rotation_sigma", motions.map(|one| Some(one.rotation_sigma_rad)));
    table
}

fn imu(motion: &FlightTracks) -> Table {
    let mut table = Table::default();
    table.integers("timestamp_ns", motion.imu.iter().map(|reading| reading.at_ns));
    table.vectors("gyro", motion.imu.iter().map(|reading| Some(reading.gyro_radps)));
    table.vectors("accel", motion.imu.iter().map(|reading| Some(reading.accel_mps2)));
    table
}

fn odometry(motion: &FlightTracks) -> Table {
    let mut table = Table::default();
    table.integers("timestamp_ns", motion.odometry.iter().map(|pose| pose.at_ns));
    table.vectors("p", motion.odometry.iter().map(|pose| Some(pose.from_body.translation_m)));
    table.rotations("q", motion.odometry.iter().map(|pose| Some(pose.from_body.rotation)));
    table
}

fn asked(motion: &FlightTracks) -> Table {
    let mut table = Table::default();
    let all = || {
        motion.asked.iter().map(|(at_ns, json)| {
            (*at_ns, serde_json::from_slice::<serde_json::Value>(json).unwrap_or_default())
        })
    };
    table.integers("timestamp_ns", all().map(|(at_ns, _)| at_ns));
    table
        .integers("observation", all().map(|(_, asked)| asked["seq"].as_u64().unwrap_or_default()));
    table.texts("setpoint", all().map(|(_, asked)| asked["setpoint"].to_string()));
    table
}

fn sent(motion: &FlightTracks) -> Table {
    let mut table = Table::default();
    let all: Vec<(u64, serde_json::Value)> = motion
        .sent
        .iter()
        .map(|(at_ns, json)| (*at_ns, serde_json::from_slice(json).unwrap_or_default()))
        .collect();
    table.integers("timestamp_ns", all.iter().map(|(at_ns, _)| *at_ns));
    for (axis, name) in ["v_x", "v_y", "v_z"].into_iter().enumerate() {
        let of = |sent: &serde_json::Value| sent["v_world_mps"][axis].as_f64().unwrap_or(f64::NAN);
        table.numbers(name, all.iter().map(|(_, sent)| of(sent)));
    }
    for name in ["yaw_rad", "yaw_rate_radps"] {
        table.numbers(name, all.iter().map(|(_, sent)| sent[name].as_f64().unwrap_or(f64::NAN)));
    }
    table
}
