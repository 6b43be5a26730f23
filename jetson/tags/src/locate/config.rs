//! Configuration file of `vizflyt tags locate`: cameras and tags.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::LocateSettings;
use crate::camera::TagCamera;
use crate::file::{self, FileError, check_number, invalid};
use crate::layout::TagLayout;
use crate::print::{Pad, PrintError};
use crate::simulated::{Sensor, over_mat};

/// Cameras, tags and vehicle of a lab. Paths are relative to the file.
///
/// ```
/// use vizflyt_tags::locate::LocateConfig;
/// let config = LocateConfig::parse(
///     "cameras = [\"west.toml\", \"east.toml\"]\nlayouts = [\"cube.toml\"]\n",
/// )
/// .unwrap();
/// assert_eq!(config.object, "vizflyt");
/// assert_eq!(config.corner_sigma_px, 0.12);
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LocateConfig {
    /// Name of the vehicle in the sent poses.
    #[serde(default = "default_object")]
    pub object: String,
    /// One to eight camera files.
    pub cameras: Vec<PathBuf>,
    /// Files with the tags of the vehicle's cube, the mat, and the walls.
    pub layouts: Vec<PathBuf>,
    /// Standard deviation of a detected corner. [px]
    #[serde(default = "default_sigma")]
    pub corner_sigma_px: f64,
    /// Maximum root mean square reprojection error of a pose; above it the pose is rejected. [px]
    #[serde(default = "default_rms")]
    pub most_rms_px: f64,
    /// Maximum tilt of the vehicle. [deg]
    #[serde(default = "default_tilt")]
    pub most_tilt_deg: f64,
    /// Standard deviation per axis of tag positions in surveyed layouts: the sigma that `tags survey mat` prints, or
    /// more for a mat that is longer than the view of one image.
    #[serde(default = "default_survey")]
    pub survey_sigma_mm: f64,
    /// Imaging of simulated cameras (`source = "simulated"`).
    #[serde(default)]
    pub simulated: SensorConfig,
}

/// [`Sensor`] in the units of files.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorConfig {
    /// Frame rate.
    pub rate_hz: f64,
    /// Exposure time.
    pub exposure_ms: f64,
    /// Standard deviation of the optical blur.
    pub blur_px: f64,
    /// Standard deviation of the sensor noise, in grey levels of 255.
    pub noise: f64,
    /// Focus distance of the lens.
    pub focus_m: f64,
    /// Aperture of the lens; 0 is a pinhole, which is sharp at every distance.
    pub aperture_mm: f64,
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self::of(&Sensor::default())
    }
}

impl SensorConfig {
    fn of(sensor: &Sensor) -> Self {
        let Sensor { rate_hz, exposure_s, blur_px, noise, focus_m, aperture_m, .. } = *sensor;
        let (exposure_ms, aperture_mm) = (exposure_s * 1e3, aperture_m * 1e3);
        Self { rate_hz, exposure_ms, blur_px, noise, focus_m, aperture_mm }
    }

    /// Returns the sensor of one of `count` cameras, which are exposed in turn.
    pub fn sensor(&self, index: usize, count: usize) -> Sensor {
        Sensor {
            rate_hz: self.rate_hz,
            phase: index as f64 / count as f64,
            exposure_s: self.exposure_ms * 1e-3,
            blur_px: self.blur_px,
            noise: self.noise,
            focus_m: self.focus_m,
            aperture_m: self.aperture_mm * 1e-3,
            ..Sensor::default()
        }
    }
}

/// A configuration with all files that it refers to.
#[derive(Clone, Debug, PartialEq)]
pub struct LocateSetup {
    /// Name of the vehicle in the sent poses.
    pub object: String,
    pub cameras: Vec<TagCamera>,
    pub layouts: Vec<TagLayout>,
    pub settings: LocateSettings,
    /// Imaging of simulated cameras.
    pub simulated: SensorConfig,
    /// True cameras and tags of a simulated lab, if they differ from those above.
    pub truth: Option<SimulatedTruth>,
}

/// Ground truth of a simulated lab, which can differ from its files.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedTruth {
    pub cameras: Vec<TagCamera>,
    pub layouts: Vec<TagLayout>,
}

impl LocateConfig {
    /// Parses a configuration from TOML.
    ///
    /// # Errors
    /// [`FileError::Toml`] if the text does not match the format, [`FileError::Invalid`] for a value out of range.
    pub fn parse(text: &str) -> Result<Self, FileError> {
        let config: Self = vizflyt_toml::parse(text)?;
        for (key, count, most) in [
            ("cameras", config.cameras.len(), MAX_CAMERAS),
            ("layouts", config.layouts.len(), MAX_LAYOUTS),
        ] {
            if !(1..=most).contains(&count) {
                return Err(invalid(key, format!("{count} files"), format!("name 1 to {most}")));
            }
        }
        if !(1..=MAX_NAME_BYTES).contains(&config.object.len()) {
            let advice = format!("give a name of 1 to {MAX_NAME_BYTES} bytes");
            return Err(invalid("object", format!("{:?}", config.object), advice));
        }
        check_number("corner_sigma_px", config.corner_sigma_px, "px", 0.01..=10.0)?;
        check_number("most_rms_px", config.most_rms_px, "px", 0.1..=100.0)?;
        check_number("survey_sigma_mm", config.survey_sigma_mm, "mm", 0.0..=100.0)?;
        check_number("most_tilt_deg", config.most_tilt_deg, "deg", 5.0..=180.0)?;
        let sensor = &config.simulated;
        check_number("simulated.rate_hz", sensor.rate_hz, "Hz", 1.0..=240.0)?;
        let most_ms = 1e3 / sensor.rate_hz;
        check_number("simulated.exposure_ms", sensor.exposure_ms, "ms", 0.0..=most_ms)?;
        check_number("simulated.blur_px", sensor.blur_px, "px", 0.0..=20.0)?;
        check_number("simulated.noise", sensor.noise, "grey levels", 0.0..=100.0)?;
        check_number("simulated.focus_m", sensor.focus_m, "m", 0.01..=1e3)?;
        check_number("simulated.aperture_mm", sensor.aperture_mm, "mm", 0.0..=100.0)?;
        Ok(config)
    }
}

impl LocateSetup {
    /// Reads a configuration file and the files that it refers to.
    ///
    /// # Errors
    /// As [`LocateConfig::parse`], and [`FileError::Io`]; the error contains the path.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let config = file::read(path, LocateConfig::parse)?;
        let beside = |name: &PathBuf| path.parent().unwrap_or(Path::new("")).join(name);
        let cameras = config.cameras.iter().map(|name| TagCamera::read(&beside(name)));
        let layouts = config.layouts.iter().map(|name| TagLayout::read(&beside(name)));
        Ok(Self {
            object: config.object.clone(),
            cameras: cameras.collect::<Result<_, _>>()?,
            layouts: layouts.collect::<Result<_, _>>()?,
            settings: LocateSettings {
                corner_sigma_px: config.corner_sigma_px,
                most_rms_px: config.most_rms_px,
                most_tilt_rad: config.most_tilt_deg.to_radians(),
                floor_m: config.survey_sigma_mm * 1e-3,
                ..LocateSettings::default()
            },
            simulated: config.simulated,
            truth: None,
        })
    }

    /// Returns the simulated lab: webcams at both ends of the netted hall, and a cube on the vehicle.
    pub fn simulated(cameras: usize, object: &str) -> Self {
        let simulated = |camera| TagCamera { source: Some(SIMULATED.into()), ..camera };
        Self {
            object: object.into(),
            cameras: crate::simulated::webcams(cameras).into_iter().map(simulated).collect(),
            layouts: vec![crate::simulated::cube()],
            settings: LocateSettings::default(),
            simulated: SensorConfig::default(),
            truth: None,
        }
    }

    /// Returns the simulated lab in which the vehicle carries a webcam over a mat. `seed` determines the errors of
    /// survey and mount.
    ///
    /// # Errors
    /// [`PrintError`] if the mat's family has too few tags for the pads.
    pub fn simulated_over_mat(pads: Vec<Pad>, seed: u64, object: &str) -> Result<Self, PrintError> {
        let layout = over_mat::floor(pads).print()?.layout;
        let camera = TagCamera { source: Some(SIMULATED.into()), ..over_mat::camera() };
        Ok(Self {
            object: object.into(),
            settings: LocateSettings {
                floor_m: over_mat::SURVEY_SIGMA_M,
                ..LocateSettings::default()
            },
            simulated: SensorConfig::of(&over_mat::sensor()),
            truth: Some(SimulatedTruth {
                cameras: vec![over_mat::as_mounted(&camera, seed)],
                layouts: vec![over_mat::as_laid(&layout, seed)],
            }),
            cameras: vec![camera],
            layouts: vec![layout],
        })
    }
}

fn default_object() -> String {
    "vizflyt".into()
}

fn default_sigma() -> f64 {
    LocateSettings::default().corner_sigma_px
}

fn default_rms() -> f64 {
    LocateSettings::default().most_rms_px
}

fn default_survey() -> f64 {
    LocateSettings::default().floor_m * 1e3
}

fn default_tilt() -> f64 {
    LocateSettings::default().most_tilt_rad.to_degrees()
}

/// Source of a simulated camera: images are rendered from the ground truth.
pub const SIMULATED: &str = "simulated";
/// Maximum number of cameras on the USB of one computer.
const MAX_CAMERAS: usize = 8;
/// Enough for a cube, a mat, and some walls.
const MAX_LAYOUTS: usize = 16;
/// Same limit as for names in motion capture.
const MAX_NAME_BYTES: usize = 24;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_invalid_values_with_their_key() {
        let good = "cameras = [\"a.toml\"]\nlayouts = [\"b.toml\"]\n";
        let check = |text: &str, part: &str| {
            let error = LocateConfig::parse(text).expect_err(text).to_string();
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        };
        LocateConfig::parse(good).unwrap();
        check("cameras = []\nlayouts = [\"b.toml\"]", "cameras = 0 files: name 1 to 8");
        check(&format!("{good}corner_sigma_px = 0.0"), "corner_sigma_px");
        check(&format!("{good}most_tilt_deg = nan"), "most_tilt_deg");
        check(&format!("{good}object = \"\""), "object");
        check(&format!("{good}camera = 1"), "camera");
        check(&format!("{good}[simulated]\nexposure_ms = 40.0"), "exposure_ms");
    }

    #[test]
    fn reads_all_files_and_reports_a_missing_one_by_name() {
        let folder = std::env::temp_dir().join(format!("vizflyt-locate-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let setup = LocateSetup::simulated(2, "wasp");
        for (camera, name) in setup.cameras.iter().zip(["a.toml", "b.toml"]) {
            camera.write(&folder.join(name)).unwrap();
        }
        let text =
            "object = \"wasp\"\ncameras = [\"a.toml\", \"b.toml\"]\nlayouts = [\"c.toml\"]\n";
        let path = folder.join("tags.toml");
        std::fs::write(&path, text).unwrap();
        let error = LocateSetup::read(&path).unwrap_err().to_string();
        assert!(error.contains("c.toml"), "{error}");
        setup.layouts[0].write(&folder.join("c.toml")).unwrap();
        let read = LocateSetup::read(&path).unwrap();
        let lenses = |setup: &LocateSetup| {
            let lens = |camera: &TagCamera| (camera.name.clone(), camera.intrinsics);
            setup.cameras.iter().map(lens).collect::<Vec<_>>()
        };
        assert_eq!(lenses(&read), lenses(&setup));
        assert_eq!((read.layouts[0].tags.len(), &*read.object), (5, "wasp"));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
