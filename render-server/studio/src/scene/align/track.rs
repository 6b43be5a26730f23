//! Alignment by a motion capture track of the camera and the times of the images.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};
use glam::DVec3;
use serde::Serialize;
use vizflyt_process::print_fmt;
use vizflyt_tags::capture::parse_stamps;
use vizflyt_twin::align::track::{self, CameraPose, TrackFit, Tracked};
use vizflyt_twin::align::{AlignError, Fit, recording};
use vizflyt_twin::dataset;

/// Times of images and track.
#[derive(Args, Clone, Debug, Default, PartialEq, Serialize)]
pub(in crate::scene) struct ClockArgs {
    /// Times of the images: lines of name,stamp_ns
    ///
    /// [default: stamps.csv of the capture, or the names of the images]
    #[arg(long, help_heading = "Track", value_name = "CSV", requires = "track")]
    times: Option<PathBuf>,
    /// Frame rate, if file names are frame numbers [Hz]
    #[arg(
        long,
        help_heading = "Track",
        value_name = "HZ",
        requires = "track",
        conflicts_with = "times"
    )]
    rate: Option<f64>,
    /// Maximum offset between the two clocks
    ///
    /// [default: 2, or 30 if their first times are far apart]
    #[arg(long, help_heading = "Track", value_name = "SECONDS", requires = "track")]
    max_offset_s: Option<f64>,
    /// Position of the tracked marker relative to the lens (right, down, forward) [m]
    ///
    /// [default: estimated]
    #[arg(
        long, help_heading = "Track",
        value_name = "X,Y,Z",
        requires = "track",
        value_parser = super::point,
        allow_hyphen_values = true
    )]
    tracked_at: Option<DVec3>,
    /// Vertical axis of the track: z, or y for Motive's default export
    #[arg(
        long,
        help_heading = "Track",
        value_enum,
        value_name = "AXIS",
        requires = "track",
        default_value_t
    )]
    track_up: TrackUp,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ValueEnum)]
enum TrackUp {
    #[default]
    Z,
    Y,
}

impl ClockArgs {
    /// Whether options define the times of the images.
    pub(in crate::scene) fn has_times(&self) -> bool {
        self.times.is_some() || self.rate.is_some()
    }
}

/// Estimates the placement of a dataset from a track.
pub(super) fn find(clocks: &ClockArgs, path: &Path, capture: &Path, sigma_m: f64) -> Result<Fit> {
    fit(clocks, path, cameras(clocks, capture)?, capture, sigma_m)
}

/// Estimates the placement of cameras from a track. `capture` names the dataset in messages.
///
/// # Errors
/// The track cannot be read, or does not match the cameras.
pub(in crate::scene) fn fit(
    clocks: &ClockArgs,
    path: &Path,
    mut cameras: Vec<CameraPose>,
    capture: &Path,
    sigma_m: f64,
) -> Result<Fit> {
    let mut track = read_track(path, clocks.track_up)?;
    ensure!(!cameras.is_empty(), "{} has no camera with a pose", capture.display());
    cameras.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    let span = |from: f64, to: f64| format!("{:.1} s", to - from);
    let [first, last] = [track[0].at_s, track[track.len() - 1].at_s];
    let [begin, end] = [cameras[0].at_s, cameras[cameras.len() - 1].at_s];
    print_fmt!("track       {} poses of {}", track.len(), span(first, last));
    print_fmt!("images      {} of {}", cameras.len(), span(begin, end));
    // Unrelated clocks can overlap a little by chance.
    let is_shared = 2.0 * (last.min(end) - first.max(begin)) > end - begin;
    if !is_shared {
        print_fmt!(
            "note        the clocks hardly overlap: both are assumed to begin at the same time"
        );
    }
    let start_s = if is_shared { begin } else { first };
    for tracked in &mut track {
        tracked.at_s -= start_s;
    }
    for camera in &mut cameras {
        camera.at_s -= begin;
    }
    let max_offset_s = clocks.max_offset_s.unwrap_or(if is_shared { 2.0 } else { 30.0 });
    let TrackFit { fit, offset_s, point_in_cam_m: p } =
        track::fit(&cameras, &track, max_offset_s, sigma_m, clocks.tracked_at)
            .map_err(|error| with_advice(error, max_offset_s))?;
    print_fmt!("clocks      {:+.3} s from the images' to the track's", offset_s + start_s - begin);
    print_fmt!(
        "tracked     {:.3}, {:.3}, {:.3} m from the lens: right, down, forward",
        p.x,
        p.y,
        p.z
    );
    check(&fit, p, path, capture)?;
    // For images with the lower edge held downwards, this is -1.
    let down =
        |camera: &CameraPose| (fit.world_from_scene.rotation * (camera.rotation * DVec3::Y)).z;
    if cameras.iter().map(down).sum::<f64>() > -0.3 * cameras.len() as f64 {
        print_fmt!(
            "note        by this, the camera was held on its side; is another axis of the track vertical (--track-up)?"
        );
    }
    ensure!(
        offset_s.abs() < max_offset_s - 0.05 || max_offset_s < 0.1,
        "the clocks differ by {offset_s:+.2} s, the maximum that was tried; increase --max-offset-s"
    );
    Ok(fit)
}

fn with_advice(error: AlignError, max_offset_s: f64) -> anyhow::Error {
    let advice = match &error {
        AlignError::HardlyMoved(_) => {
            "the position of the tracked marker relative to the lens cannot be estimated; measure it and give --tracked-at"
                .to_owned()
        }
        AlignError::TooFew { .. } => format!(
            "the recording covers too few of the images, or the clocks differ by more than {max_offset_s} s \
             (--max-offset-s)"
        ),
        _ => return error.into(),
    };
    anyhow::Error::from(error).context(advice)
}

/// Rejects a fit with large residuals: a similarity fits any two paths somehow, even unrelated ones.
fn check(fit: &Fit, point_in_cam_m: DVec3, path: &Path, capture: &Path) -> Result<()> {
    let used = fit.used + fit.left_out;
    if fit.rms_m > MOST_LEFT_M || fit.left_out * 4 > used || point_in_cam_m.length() > ARM_M {
        bail!(
            "{} is not the track of the camera of {}: residual {:.0} cm rms, {} of {used} images do not fit; is it of the \
             same recording, of the right object, with the right times (--times, --rate), and z up (--track-up)?",
            path.display(),
            capture.display(),
            fit.rms_m * 1e2,
            fit.left_out
        );
    }
    Ok(())
}

fn read_track(path: &Path, up: TrackUp) -> Result<Vec<Tracked>> {
    let size = std::fs::metadata(path).map(|file| file.len());
    let size = size.with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(
        size <= MAX_BYTES,
        "{} has {} MB; cut the recording to the time of the capture: the maximum is {} MB",
        path.display(),
        size >> 20,
        MAX_BYTES >> 20
    );
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read {} as text", path.display()))?;
    let mut track = recording::parse(&text).with_context(|| path.display().to_string())?;
    if up == TrackUp::Y {
        for Tracked { position_m: p, .. } in &mut track {
            *p = DVec3::new(p.x, -p.z, p.y);
        }
    }
    let mut gaps: Vec<f64> = track.windows(2).map(|two| two[1].at_s - two[0].at_s).collect();
    gaps.sort_by(f64::total_cmp);
    let gap_s = gaps[gaps.len() / 2];
    ensure!(
        gap_s <= 0.1,
        "{}: {:.1} poses per second are too few for a hand-held camera; the minimum is 10, and 100 is good",
        path.display(),
        1.0 / gap_s
    );
    Ok(track)
}

/// Returns the camera poses of a capture with their times.
fn cameras(clocks: &ClockArgs, capture: &Path) -> Result<Vec<CameraPose>> {
    let poses = dataset::read_poses(capture)?;
    let names: Vec<&str> = poses.iter().map(|(name, _)| name.as_str()).collect();
    let times_s = times(clocks, capture, &names)?;
    let cameras = poses
        .iter()
        .zip(times_s)
        .map(|((_, pose), at_s)| CameraPose {
            at_s,
            position: pose.translation_m,
            rotation: pose.rotation,
        })
        .collect();
    Ok(cameras)
}

/// Returns the times of images. [s]
pub(in crate::scene) fn times(
    clocks: &ClockArgs,
    capture: &Path,
    names: &[&str],
) -> Result<Vec<f64>> {
    let beside = [capture.join("stamps.csv"), capture.join("images/stamps.csv")];
    let beside = beside.into_iter().find(|path| path.is_file() && clocks.rate.is_none());
    if let Some(path) = clocks.times.clone().or(beside) {
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        let stamps = parse_stamps(&text).map_err(anyhow::Error::msg);
        return of_table(&stamps.with_context(|| path.display().to_string())?, names)
            .with_context(|| path.display().to_string());
    }
    if let Some(rate_hz) = clocks.rate {
        ensure!(rate_hz > 0.0 && rate_hz.is_finite(), "--rate {rate_hz} is not a rate");
        return names
            .iter()
            .map(|name| {
                let count = stem(name).trim_start_matches(|c: char| !c.is_ascii_digit());
                let count = count.parse::<u64>().ok();
                Ok(count.with_context(|| counted(name))? as f64 / rate_hz)
            })
            .collect();
    }
    names
        .iter()
        .map(|name| {
            let stem = stem(name);
            let digits = stem.trim_start_matches(|c: char| !c.is_ascii_digit());
            if digits.len() >= 16 && let Ok(ns) = digits.parse::<u64>() {
                return Ok(ns as f64 * 1e-9);
            }
            let is_decimal = digits.contains('.') && digits.bytes().all(|b| b.is_ascii_digit() || b == b'.');
            let seconds = digits.parse::<f64>().ok().filter(|_| is_decimal);
            seconds.with_context(|| {
                format!(
                    "the time of {name} is not known: its name is not a time; give --times with lines of name,stamp_ns, or \
                     --rate if file names are frame numbers"
                )
            })
        })
        .collect()
}

/// Returns the stamps of images from a table, by names with or without folders. [s]
fn of_table(stamps: &HashMap<String, u64>, names: &[&str]) -> Result<Vec<f64>> {
    names
        .iter()
        .map(|name| {
            let short = Path::new(name).file_name().and_then(|file| file.to_str()).unwrap_or(name);
            let stamp_ns = stamps.get(*name).or_else(|| stamps.get(short));
            Ok(*stamp_ns.with_context(|| format!("no line for {name}"))? as f64 * 1e-9)
        })
        .collect()
}

fn stem(name: &str) -> &str {
    Path::new(name).file_stem().and_then(|stem| stem.to_str()).unwrap_or(name)
}

fn counted(name: &str) -> String {
    format!("{name} does not end with a frame number, which --rate needs; give --times")
}

/// Maximum RMS residual. Structure from motion and motion capture agree within 2 cm. [m]
const MOST_LEFT_M: f64 = 0.04;
/// Maximum distance of the marker, which is fixed to the camera or to the person who carries it. [m]
const ARM_M: f64 = 1.5;
/// Maximum file size: one hour at 1 kHz.
const MAX_BYTES: u64 = 512 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn clocks(rate: Option<f64>) -> ClockArgs {
        ClockArgs { times: None, rate, max_offset_s: None, tracked_at: None, track_up: TrackUp::Z }
    }

    #[test]
    fn reads_times_from_options_tables_and_names() {
        let folder = tempfile::tempdir().unwrap();
        let found = |rate, names: &[&str]| times(&clocks(rate), folder.path(), names);
        let seconds = |rate, names: &[&str]| found(rate, names).unwrap();
        assert_eq!(seconds(None, &["images/1700000000500000000.png"]), [1_700_000_000.5]);
        assert_eq!(seconds(None, &["frame_12.25.jpg"]), [12.25]);
        assert_eq!(seconds(Some(30.0), &["frame_00045.jpg", "90.png"]), [1.5, 3.0]);
        let refused = |rate, name: &str, expected: &str| {
            let error = format!("{:#}", found(rate, &[name]).unwrap_err());
            assert!(error.contains(expected), "'{error}' lacks '{expected}'");
        };
        refused(None, "frame_00045.jpg", "--rate");
        refused(None, "door.jpg", "not known");
        refused(Some(30.0), "door.jpg", "frame number");
        refused(Some(0.0), "1.jpg", "not a rate");
        std::fs::write(folder.path().join("stamps.csv"), "name,stamp_ns\n1.png,500000000\n")
            .unwrap();
        assert_eq!(seconds(None, &["images/1.png"]), [0.5]);
        refused(None, "2.png", "no line for 2.png");
    }
}
