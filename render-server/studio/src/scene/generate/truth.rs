//! `truth.json`: true camera poses and exposures of a generated capture (`docs/guides/capture.md`).

use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::LensConfig;
use vizflyt_scenes::film::{Exposure, Film, Phone, Track};
use vizflyt_tags::file::PoseConfig;
use vizflyt_tags::layout::{Tag, TagLayout};

use super::film::Shoot;

/// Content of `truth.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CaptureTruth {
    /// Format version: 1. It changes if a field changes its meaning.
    pub version: u32,
    pub scene: SceneTruth,
    pub camera: CameraTruth,
    /// Images in order; of a video, all of them.
    pub images: Vec<ImageTruth>,
    /// Tags, as in `tags.toml`. [m, world]
    pub tags: Vec<Tag>,
}

/// Captured scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SceneTruth {
    /// Kind, as in `vizflyt scene generate KIND`.
    pub kind: String,
    pub seed: u64,
    /// Whether moving objects were animated.
    pub moving: bool,
}

/// Camera. Pixel coordinates are continuous: (0, 0) is the image's corner, (0.5, 0.5) the centre of the first pixel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CameraTruth {
    pub width_px: u32,
    pub height_px: u32,
    pub fx_px: f64,
    pub fy_px: f64,
    pub cx_px: f64,
    pub cy_px: f64,
    /// Distortion as defined by OpenCV.
    pub distortion: Option<LensConfig>,
    /// Time from the exposure of the upper edge to that of the lower edge, linear in between. [s]
    pub readout_s: f64,
    /// Frame rate of a video; null for a folder. [Hz]
    pub rate_hz: Option<f64>,
}

/// True pose and exposure of an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ImageTruth {
    /// File name in a folder; null in a video.
    pub file: Option<String>,
    /// Middle of the exposure of the image's middle row. [ns since the start of the walk]
    pub stamp_ns: u64,
    /// Pose at `stamp_ns`. [m, world]
    pub world_from_cam: PoseConfig,
    /// Pose in the middle of the exposure of the upper edge. [m, world]
    pub upper_edge: PoseConfig,
    /// Pose in the middle of the exposure of the lower edge. [m, world]
    pub lower_edge: PoseConfig,
    /// Factor applied to the scene's linear light.
    pub gain: f64,
    /// Exposure time of each row. [s]
    pub shutter_s: f64,
    pub iso: f64,
}

impl CaptureTruth {
    /// Returns the content of the file.
    pub(super) fn new(
        shoot: &Shoot,
        phone: &Phone,
        images: Vec<ImageTruth>,
        layout: Option<&TagLayout>,
    ) -> Self {
        let k = &phone.intrinsics;
        Self {
            version: 1,
            scene: SceneTruth {
                kind: shoot.kind().name().to_owned(),
                seed: shoot.seed(),
                moving: shoot.moving(),
            },
            camera: CameraTruth {
                width_px: k.width_px,
                height_px: k.height_px,
                fx_px: k.fx_px,
                fy_px: k.fy_px,
                cx_px: k.cx_px,
                cy_px: k.cy_px,
                distortion: LensConfig::new(k.distortion),
                readout_s: phone.readout_s,
                rate_hz: shoot.rate_hz(),
            },
            images,
            tags: layout.map_or_else(Vec::new, |layout| layout.tags.clone()),
        }
    }

    /// Writes the file as JSON.
    pub(super) fn write(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self)?;
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
    }
}

impl ImageTruth {
    /// Returns the entry of an image with its middle row exposed at `middle_s`.
    pub(super) fn new(
        film: &Film,
        track: &Track<'_>,
        middle_s: f64,
        exposure: &Exposure,
        file: Option<String>,
    ) -> Self {
        let phone = film.phone();
        let at = |row: f64| PoseConfig::new(track(phone.row_instant_s(row, middle_s)));
        let height = f64::from(phone.intrinsics.height_px);
        Self {
            file,
            stamp_ns: (middle_s * 1e9).round() as u64,
            world_from_cam: at(height / 2.0),
            upper_edge: at(0.0),
            lower_edge: at(height),
            gain: exposure.gain,
            shutter_s: exposure.shutter_s,
            iso: exposure.iso,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Example of `docs/guides/capture.md`. It must change if a field is added, renamed or removed.
    const EXAMPLE: &str = include_str!("truth.example.json");

    #[test]
    fn the_documented_example_is_valid_and_complete() {
        let truth: CaptureTruth = serde_json::from_str(EXAMPLE).unwrap();
        assert_eq!(truth.version, 1);
        let back = serde_json::to_value(&truth).unwrap();
        let example: serde_json::Value = serde_json::from_str(EXAMPLE).unwrap();
        assert_eq!(back, example, "a field is written otherwise than read");
        let guide = include_str!("../../../../../docs/guides/capture.md");
        assert!(guide.contains(EXAMPLE.trim()), "docs/guides/capture.md shows another file");
    }

    #[test]
    fn rejects_missing_and_unknown_fields() {
        let read =
            |text: &str| serde_json::from_str::<CaptureTruth>(text).map_err(|e| e.to_string());
        for (from, to, part) in [
            ("\"readout_s\": 0.022,", "", "readout_s"),
            ("\"gain\"", "\"brightness\"", "brightness"),
            ("\"stamp_ns\": 0,", "\"stamp_ns\": -1,", "-1"),
        ] {
            let text = EXAMPLE.replacen(from, to, 1);
            assert_ne!(text, EXAMPLE, "{from} is not in the example");
            let error = read(&text).unwrap_err();
            assert!(error.contains(part), "{error}");
        }
    }
}
