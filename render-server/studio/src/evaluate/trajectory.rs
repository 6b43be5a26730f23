//! Trajectories: poses with times, from a file or from a topic of a flight log.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Cam, Pose, World};
use vizflyt_runtime::log::read::{LogReader, RecordedPoses};
use vizflyt_twin::dataset;

/// Pose at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stamped {
    /// [s]
    pub at_s: f64,
    /// [m]
    pub position_m: DVec3,
    /// Rotation from the body's axes to the trajectory's frame.
    pub rotation: DQuat,
}

/// Reads a trajectory in order of time: TUM text, EuRoC CSV, or `FLIGHT.mcap#TOPIC` (default topic: `/pose`).
///
/// # Errors
/// The file is invalid; the message includes the line.
pub fn read(source: &str) -> Result<Vec<Stamped>> {
    let topic_at = [".mcap#", ".mcap:"].iter().find_map(|mark| source.split_once(mark));
    let (path, topic) = match topic_at {
        Some((name, topic)) => (format!("{name}.mcap"), topic),
        None => (source.to_owned(), "/pose"),
    };
    let path = Path::new(&path);
    let context = || format!("cannot read {source}");
    if path.extension().is_some_and(|extension| extension == "mcap") {
        return of_log(path, topic).with_context(context);
    }
    let size = std::fs::metadata(path).with_context(context)?.len();
    ensure!(
        size <= LARGEST,
        "{source} has {} MB; the maximum of a trajectory is {} MB",
        size >> 20,
        LARGEST >> 20
    );
    let text = std::fs::read(path).with_context(context)?;
    parse(&String::from_utf8_lossy(&text)).with_context(context)
}

/// Reads the camera poses of the photos that two datasets have in common, in order of their names, one second apart.
///
/// # Errors
/// A folder is not a dataset, or the two have no photo in common.
pub fn of_photos(truth: &str, estimate: &str) -> Result<(Vec<Stamped>, Vec<Stamped>)> {
    let read = |folder: &str| -> Result<BTreeMap<String, _>> {
        let poses = dataset::read_poses(Path::new(folder))?;
        // The folder part of the names differs between programs.
        let file = |name: &str| name.rsplit('/').next().unwrap_or(name).to_owned();
        Ok(poses.into_iter().map(|(name, pose)| (file(&name), pose)).collect())
    };
    let (truths, mut estimates) = (read(truth)?, read(estimate)?);
    let mut both = (Vec::new(), Vec::new());
    for (name, of_truth) in truths {
        let Some(of_estimate) = estimates.remove(&name) else { continue };
        let stamped = |pose: Pose<World, Cam>| Stamped {
            at_s: both.0.len() as f64,
            position_m: pose.translation_m,
            rotation: pose.rotation.normalize(),
        };
        let (of_truth, of_estimate) = (stamped(of_truth), stamped(of_estimate));
        both.0.push(of_truth);
        both.1.push(of_estimate);
    }
    ensure!(!both.0.is_empty(), "no photo of {truth} has the name of one of {estimate}");
    Ok(both)
}

fn of_log(path: &Path, topic: &str) -> Result<Vec<Stamped>> {
    let mut poses = RecordedPoses::of_topic(LogReader::open(path)?, topic);
    let mut found = Vec::new();
    while let Some(pose) = poses.next()? {
        let world_from_body = pose.world_from_body;
        found.push(Stamped {
            at_s: pose.at_ns as f64 * 1e-9,
            position_m: world_from_body.translation_m,
            rotation: world_from_body.rotation.normalize(),
        });
    }
    ensure!(
        !found.is_empty(),
        "there is no pose on {topic}; give a topic of poses as FLIGHT.mcap#/pose, #/pose_at_image or #/odometry"
    );
    found.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    found.dedup_by_key(|pose| pose.at_s);
    Ok(found)
}

/// Reads TUM text (`stamp_s tx ty tz qx qy qz qw`, with spaces) or EuRoC CSV (`stamp_ns,x,y,z,qw,qx,qy,qz,...`).
fn parse(text: &str) -> Result<Vec<Stamped>> {
    let mut found: Vec<Stamped> = Vec::new();
    for (k, row) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let (line, row) = (k + 1, row.trim());
        // EuRoC's header begins with #, like comments; other headers begin with a word.
        if row.is_empty()
            || row.starts_with('#')
            || found.is_empty() && row.starts_with(char::is_alphabetic)
        {
            continue;
        }
        let pose = pose(row).with_context(|| format!("line {line}: '{}'", shortened(row)))?;
        match found.last().map(|last| last.at_s) {
            Some(last_s) if pose.at_s < last_s => {
                bail!(
                    "line {line}: time goes back, from {last_s} to {} s; sort it by time",
                    pose.at_s
                )
            }
            // Of several poses with the same stamp, the first is used.
            Some(last_s) if pose.at_s == last_s => {}
            _ => found.push(pose),
        }
    }
    ensure!(
        !found.is_empty(),
        "it contains no pose; expected lines of `stamp tx ty tz qx qy qz qw`"
    );
    Ok(found)
}

fn pose(row: &str) -> Result<Stamped> {
    let is_csv = row.contains(',');
    let cells: Vec<&str> = if is_csv {
        row.split(',').map(str::trim).collect()
    } else {
        row.split_whitespace().collect()
    };
    // EuRoC files have velocity and biases after the pose.
    let fits = if is_csv { cells.len() >= 8 } else { cells.len() == 8 };
    ensure!(
        fits,
        "{} numbers instead of 8: stamp tx ty tz qx qy qz qw, or EuRoC's CSV",
        cells.len()
    );
    let mut numbers = [0.0; 8];
    for (number, cell) in numbers.iter_mut().zip(&cells) {
        *number = cell
            .parse()
            .ok()
            .filter(|value: &f64| value.is_finite())
            .with_context(|| format!("'{cell}' is not a finite number"))?;
    }
    let [stamp, x, y, z, a, b, c, d] = numbers;
    let (at_s, rotation) = if is_csv {
        (stamp * 1e-9, DQuat::from_xyzw(b, c, d, a))
    } else {
        (stamp, DQuat::from_xyzw(a, b, c, d))
    };
    let length = rotation.length();
    ensure!(
        (0.9..1.1).contains(&length),
        "the quaternion has length {length:.3}; a rotation has length 1"
    );
    let position_m = DVec3::new(x, y, z);
    ensure!(
        position_m.abs().max_element() <= FARTHEST_M,
        "position {position_m:.0} m is out of range; are these metres?"
    );
    Ok(Stamped { at_s, position_m, rotation: rotation.normalize() })
}

fn shortened(row: &str) -> String {
    row.chars().take(60).collect()
}

/// Maximum file size: hours at 1 kHz. [bytes]
const LARGEST: u64 = 1 << 30;
const FARTHEST_M: f64 = 1e7;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn tum_and_euroc_are_the_same_pose() {
        let tum = parse("# stamp\n1.5 1 2 3 0.1 0.2 0.3 0.927361849549570\n").unwrap();
        let euroc = "#timestamp [ns],p_x [m],p_y,p_z,q_w,q_x,q_y,q_z,v_x\n1500000000,1,2,3,0.927361849549570,0.1,0.2,0.3,9\n";
        let euroc = parse(euroc).unwrap();
        assert_eq!((tum.len(), euroc.len()), (1, 1));
        assert!((tum[0].at_s - euroc[0].at_s).abs() < 1e-12);
        assert_eq!((tum[0].position_m, tum[0].rotation), (euroc[0].position_m, euroc[0].rotation));
    }

    #[test]
    fn errors_state_the_problem_and_its_line() {
        for (text, told) in [
            ("", "no pose"),
            ("1 2 3\n", "3 numbers"),
            ("0 0 0 0 0 0 0 1\n1 0 0 x 0 0 0 1\n", "line 2"),
            ("0 0 0 0 0 0 0 0\n", "length 0.000"),
            ("0 0 0 0 0 0 0 nan\n", "not a finite number"),
            ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "time goes back"),
            ("1 0 0 1e9 0 0 0 1\n", "metres"),
        ] {
            let error = format!("{:#}", parse(text).unwrap_err());
            assert!(error.contains(told), "{text:?}: {error}");
        }
    }

    #[test]
    fn compares_photos_with_the_same_name() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, frames: &[(&str, f64)]| {
            let path = folder.path().join(name);
            std::fs::create_dir(&path).unwrap();
            let frames: Vec<_> = frames
                .iter()
                .map(|(file, x)| {
                    let pose = [[1.0, 0.0, 0.0, *x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
                    let rows = [pose[0], pose[1], pose[2], [0.0, 0.0, 0.0, 1.0]];
                    serde_json::json!({"file_path": file, "transform_matrix": rows})
                })
                .collect();
            let text = serde_json::json!({"camera_angle_x": 1.0, "frames": frames}).to_string();
            std::fs::write(path.join("transforms.json"), text).unwrap();
            path.to_str().unwrap().to_owned()
        };
        let truth = write("truth", &[("images/b.png", 2.0), ("images/a.png", 1.0), ("c.png", 3.0)]);
        let estimate = write("estimate", &[("a.png", 10.0), ("b.png", 20.0), ("d.png", 40.0)]);
        let (truths, estimates) = of_photos(&truth, &estimate).unwrap();
        let x = |poses: &[Stamped]| -> Vec<[f64; 2]> {
            poses.iter().map(|pose| [pose.at_s, pose.position_m.x]).collect()
        };
        assert_eq!(x(&truths), [[0.0, 1.0], [1.0, 2.0]]);
        assert_eq!(x(&estimates), [[0.0, 10.0], [1.0, 20.0]]);
        let other = write("other", &[("e.png", 0.0), ("f.png", 1.0)]);
        assert!(of_photos(&truth, &other).unwrap_err().to_string().contains("no photo of"));
    }

    proptest! {
        #[test]
        fn any_text_is_parsed_to_valid_poses_or_rejected(text in "[0-9eE+.,# \\-\na-c]{0,200}") {
            if let Ok(poses) = parse(&text) {
                prop_assert!(poses.is_sorted_by(|a, b| a.at_s < b.at_s));
                prop_assert!(poses.iter().all(|pose| pose.rotation.is_normalized()));
            }
        }
    }
}
