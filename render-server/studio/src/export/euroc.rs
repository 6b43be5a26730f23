//! EuRoC's layout (M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016): `mav0/cam0/data/NS.png`,
//! `imu0`, `state_groundtruth_estimate0`, each with its `data.csv` and `sensor.yaml`.
//!
//! Its body frame is that of VizFlyt (x forward, y left, z up), with the IMU at its origin. EuRoC defines no depth; it
//! is written to `mav0/depth0` as 16-bit PNG in millimetres.

use std::fmt::Write;

use anyhow::Result;
use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Cam, Distortion, Frame, Intrinsics, Pose, World};

use super::files::{Folder, write_depth, write_rgb};
use super::motion::FlightTracks;
use super::pictures::Pictures;
use super::table::{Row, write_beside};
use super::{Written, write_text};

/// Files of a camera.
struct Sensor {
    camera: String,
    intrinsics: Intrinsics,
    body_from_cam: Pose<Body, Cam>,
    images: Vec<u64>,
    depths: Vec<u64>,
}

/// Writes the data set.
pub(super) fn write(
    folder: &Folder,
    motion: &FlightTracks,
    mut pictures: Pictures,
) -> Result<Written> {
    let mut sensors: Vec<Sensor> = Vec::new();
    let mut rows = Vec::new();
    while let Some(mut image) = pictures.next(|_| true)? {
        let known = sensors.iter().position(|sensor| sensor.camera == image.camera);
        let index = known.unwrap_or_else(|| {
            sensors.push(Sensor {
                camera: image.camera.clone(),
                intrinsics: image.header.intrinsics(),
                body_from_cam: image.header.body_from_cam(),
                images: Vec::new(),
                depths: Vec::new(),
            });
            sensors.len() - 1
        });
        let size = (image.header.width_px.get(), image.header.height_px.get());
        let at_ns = image.shown_ns;
        let file = format!("mav0/cam{index}/data/{at_ns}.png");
        write_rgb(&folder.at(&file)?, &pictures.rgb, size)?;
        sensors[index].images.push(at_ns);
        let mut depth_file = String::new();
        if pictures.has_depth() {
            depth_file = format!("mav0/depth{index}/data/{at_ns}.png");
            write_depth(&folder.at(&depth_file)?, &pictures.depth_mm, size, 1)?;
            sensors[index].depths.push(at_ns);
        }
        image.bitstream = Vec::new();
        rows.push(Row { image, file, depth_file });
    }
    for (index, sensor) in sensors.iter().enumerate() {
        camera(folder, &format!("mav0/cam{index}"), sensor, &sensor.images)?;
        if !sensor.depths.is_empty() {
            camera(folder, &format!("mav0/depth{index}"), sensor, &sensor.depths)?;
        }
    }
    imu(folder, motion)?;
    truth(folder, motion)?;
    write_beside(folder, motion, &rows)?;
    Ok(Written { images: rows.len(), broken: pictures.broken })
}

fn camera(folder: &Folder, path: &str, sensor: &Sensor, stamps: &[u64]) -> Result<()> {
    write_text(&folder.at(&format!("{path}/data.csv"))?, &images_csv(stamps, "png"))?;
    let Sensor { camera, intrinsics, body_from_cam, .. } = sensor;
    let text = camera_yaml(camera, intrinsics, body_from_cam, stamps);
    write_text(&folder.at(&format!("{path}/sensor.yaml"))?, &text)
}

/// Returns the list of a camera's images, which are named by their times.
pub(crate) fn images_csv(stamps: &[u64], ending: &str) -> String {
    let mut text = "#timestamp [ns],filename\n".to_owned();
    for at_ns in stamps {
        let _ = writeln!(text, "{at_ns},{at_ns}.{ending}");
    }
    text
}

/// Returns a camera's `sensor.yaml`.
pub(crate) fn camera_yaml(
    comment: &str,
    k: &Intrinsics,
    body_from_cam: &Pose<Body, Cam>,
    stamps: &[u64],
) -> String {
    let (model, coefficients) = match k.distortion {
        Distortion::None => ("radial-tangential", vec![0.0; 4]),
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
            let fifth = Some(k3).filter(|k3| *k3 != 0.0);
            ("radial-tangential", [k1, k2, p1, p2].into_iter().chain(fifth).collect())
        }
        Distortion::KannalaBrandt { .. } => ("equidistant", k.distortion.to_wire().1[..4].to_vec()),
    };
    // OpenCV's convention: the centre of the first pixel is 0.
    let intrinsics = [k.fx_px, k.fy_px, k.cx_px - 0.5, k.cy_px - 0.5];
    format!(
        "sensor_type: camera\ncomment: {comment}\n{}rate_hz: {:.3}\nresolution: [{}, {}]\ncamera_model: pinhole\n\
         intrinsics: {intrinsics:?} # fu, fv, cu, cv\ndistortion_model: {model}\n\
         distortion_coefficients: {coefficients:?}\n",
        transform(body_from_cam),
        rate_hz(stamps),
        k.width_px,
        k.height_px,
    )
}

/// Returns the pose of a sensor in the body as YAML.
pub(super) fn transform<A: Frame>(body_from_sensor: &Pose<Body, A>) -> String {
    let p = body_from_sensor.translation_m;
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| body_from_sensor.rotate(axis));
    let row = |k: usize| format!("{}, {}, {}, {}", axes[0][k], axes[1][k], axes[2][k], p[k]);
    format!(
        "T_BS: # from the sensor to the body\n  cols: 4\n  rows: 4\n  data: [{},\n         {},\n         {},\n         \
         0.0, 0.0, 0.0, 1.0]\n",
        row(0),
        row(1),
        row(2)
    )
}

/// Returns the mean rate of readings from the first to the last. [Hz]
pub(super) fn rate_hz(stamps: &[u64]) -> f64 {
    let seconds = stamps
        .last()
        .zip(stamps.first())
        .map_or(0.0, |(last, first)| last.abs_diff(*first) as f64 * 1e-9);
    if seconds > 0.0 { (stamps.len() - 1) as f64 / seconds } else { 0.0 }
}

fn imu(folder: &Folder, motion: &FlightTracks) -> Result<()> {
    let mut text = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],\
                    a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
        .to_owned();
    for reading in &motion.imu {
        let (w, a) = (reading.gyro_radps, reading.accel_mps2);
        let _ = writeln!(text, "{},{},{},{},{},{},{}", reading.at_ns, w.x, w.y, w.z, a.x, a.y, a.z);
    }
    write_text(&folder.at("mav0/imu0/data.csv")?, &text)?;
    let stamps: Vec<u64> = motion.imu.iter().map(|reading| reading.at_ns).collect();
    let text = format!(
        "sensor_type: imu\ncomment: IMU of the autopilot\n{}rate_hz: {:.3}\n",
        transform::<Body>(&Pose::IDENTITY),
        rate_hz(&stamps)
    );
    write_text(&folder.at("mav0/imu0/sensor.yaml")?, &text)
}

fn truth(folder: &Folder, motion: &FlightTracks) -> Result<()> {
    let rows = motion.poses.iter().map(|pose| TruthRow {
        at_ns: pose.at_ns,
        world_from_body: pose.from_body,
        v_world_mps: motion.motion_at(pose.at_ns).v_world_mps,
    });
    let path = "mav0/state_groundtruth_estimate0";
    write_text(&folder.at(&format!("{path}/data.csv"))?, &truth_csv(rows))?;
    let text = truth_yaml("localized pose of the body in the world");
    write_text(&folder.at(&format!("{path}/sensor.yaml"))?, &text)
}

/// True motion of the body at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TruthRow {
    pub(crate) at_ns: u64,
    pub(crate) world_from_body: Pose<World, Body>,
    pub(crate) v_world_mps: DVec3,
}

/// Returns the list of true motions as CSV. Biases are unknown and written as 0.
pub(crate) fn truth_csv(rows: impl Iterator<Item = TruthRow>) -> String {
    let mut text = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], \
                    v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], \
                    b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], \
                    b_a_RS_S_z [m s^-2]\n"
        .to_owned();
    for TruthRow { at_ns, world_from_body, v_world_mps: v } in rows {
        let (p, q) = (world_from_body.translation_m, world_from_body.rotation);
        let _ = writeln!(
            text,
            "{at_ns},{},{},{},{},{},{},{},{},{},{},0,0,0,0,0,0",
            p.x, p.y, p.z, q.w, q.x, q.y, q.z, v.x, v.y, v.z
        );
    }
    text
}

/// Returns the `sensor.yaml` for the list of true motions.
pub(crate) fn truth_yaml(comment: &str) -> String {
    format!(
        "sensor_type: visual-inertial\ncomment: {comment}\n{}",
        transform::<Body>(&Pose::IDENTITY)
    )
}
