//! `[cameras.imaging]`: a named image sensor and depth camera, and values that override theirs.

use serde::{Deserialize, Serialize};

use super::validate::{ConfigError, check_number, invalid};

mod presets;

pub use presets::{DEPTHS, DepthSensor, LightSensor, SENSORS, StereoPair, TimeOfFlight};

/// `[cameras.imaging]`; without it images are perfect.
///
/// ```
/// let text = r#"
/// sensor = "imx219"
/// illuminance_lx = 200.0
/// denoise = true
/// depth = { model = "d435", max_m = 6.0 }
/// "#;
/// let imaging: vizflyt_arena::config::ImagingConfig = toml::from_str(text).unwrap();
/// let sensor = imaging.light_sensor().unwrap();
/// assert_eq!((sensor.pixel_um, sensor.illuminance_lx, sensor.denoise), (1.12, 200.0, true));
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImagingConfig {
    /// Image sensor, one of [`SENSORS`]; without it, the sensor is perfect. Other absent keys take this
    /// sensor's value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sensor: Option<String>,
    /// Fixed exposure of each row; without it, the exposure is automatic. [ms]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_ms: Option<f64>,
    /// Analogue gain of a fixed exposure; default 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// Time constant of the automatic exposure. [s]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_lag_s: Option<f64>,
    /// Maximum shutter time of the automatic exposure. [ms]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_exposure_ms: Option<f64>,
    /// Maximum gain of the automatic exposure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gain: Option<f64>,
    /// Illuminance of the scene: white in the scene's file is as bright as white paper in this light. [lx]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub illuminance_lx: Option<f64>,
    /// F-number of the lens: focal length divided by aperture.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub f_number: Option<f64>,
    /// Sensor pixels per image pixel, along each side; without it, the width of the sensor divided by that of
    /// the image.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub binning: Option<u32>,
    /// Full-well capacity: maximum number of electrons in a sensor pixel. [e]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub full_well_e: Option<f64>,
    /// Read noise of a sensor pixel, one standard deviation. [e]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub read_noise_e: Option<f64>,
    /// Rolling shutter: time from the first row's exposure to the last row's; 0 for a global shutter. [ms]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub readout_ms: Option<f64>,
    /// Vignetting: share of the light that is lost in the corners.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vignette: Option<f64>,
    /// Colour filter of the pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter: Option<FilterKind>,
    /// Whether the camera denoises its images; default `false`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub denoise: Option<bool>,
    /// Whether to simulate photon noise and read noise; default `true`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<bool>,
    /// Depth camera to simulate; without it, depth is perfect.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<DepthConfig>,
}

/// `filter`: colour filter in front of a sensor's pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FilterKind {
    /// Three colours in every image pixel, as if it combined many sensor pixels.
    Rgb,
    /// One colour per pixel, interpolated.
    Bayer,
    /// No filter: images are grey.
    Mono,
}

/// `depth`: a named depth camera, and values that override its own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthConfig {
    /// Depth camera, one of [`DEPTHS`]. Other absent keys take this camera's value.
    pub model: String,
    /// Minimum reported distance, for time-of-flight cameras. [m]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_m: Option<f64>,
    /// Maximum reported distance. [m]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_m: Option<f64>,
    /// Distance between the two cameras of a stereo pair. [mm]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baseline_mm: Option<f64>,
    /// Focal length of the images that a stereo pair matches. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focal_px: Option<f64>,
    /// Noise of a stereo pair's disparities, one standard deviation. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subpixel_px: Option<f64>,
    /// Foreground fattening of a stereo pair: width by which near objects extend over the background. [px]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fattening_px: Option<f64>,
    /// Whether a projector adds texture to blank walls; without one, blank walls have no depth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub projector: Option<bool>,
    /// Modulation frequency of a time-of-flight camera's light; if only this is given, `unambiguous_m` follows
    /// from it. [MHz]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub modulation_mhz: Option<f64>,
    /// Unambiguous range of a time-of-flight camera: beyond it, distances restart at 0. [m]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unambiguous_m: Option<f64>,
    /// Signal of the camera's own light, reflected by a white surface at 1 m. [e]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signal_e: Option<f64>,
    /// Signal of ambient light. [e]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub background_e: Option<f64>,
    /// Whether to simulate multipath: light that arrives by way of other surfaces.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub multipath: Option<bool>,
}

fn listed(names: impl Iterator<Item = &'static str>) -> String {
    names.collect::<Vec<_>>().join(", ")
}

impl ImagingConfig {
    /// Returns the image sensor with all overrides; `None` is a perfect one, or a name that validation rejects.
    pub fn light_sensor(&self) -> Option<LightSensor> {
        let name = self.sensor.as_ref()?;
        let preset = SENSORS.iter().find(|(known, _)| known == name)?.1;
        let ms = |value: Option<f64>| value.map(|ms| ms * 1e-3);
        Some(LightSensor {
            fixed_s: ms(self.exposure_ms),
            fixed_gain: self.gain.unwrap_or(1.0),
            lag_s: self.exposure_lag_s.unwrap_or(preset.lag_s),
            most_shutter_s: ms(self.max_exposure_ms).unwrap_or(preset.most_shutter_s),
            most_gain: self.max_gain.unwrap_or(preset.most_gain),
            illuminance_lx: self.illuminance_lx.unwrap_or(preset.illuminance_lx),
            f_number: self.f_number.unwrap_or(preset.f_number),
            binning: self.binning,
            full_well_e: self.full_well_e.unwrap_or(preset.full_well_e),
            read_noise_e: self.read_noise_e.unwrap_or(preset.read_noise_e),
            readout_s: ms(self.readout_ms).unwrap_or(preset.readout_s),
            vignette: self.vignette.unwrap_or(preset.vignette),
            filter: self.filter.unwrap_or(preset.filter),
            denoise: self.denoise.unwrap_or(preset.denoise),
            noise: self.noise.unwrap_or(preset.noise),
            ..preset
        })
    }

    /// Returns the depth camera with all overrides; `None` is a perfect one, or a name that validation rejects.
    pub fn depth_sensor(&self) -> Option<DepthSensor> {
        let config = self.depth.as_ref()?;
        let preset = DEPTHS.iter().find(|(known, _)| *known == config.model)?.1;
        Some(match preset {
            DepthSensor::Stereo(stereo) => DepthSensor::Stereo(StereoPair {
                baseline_m: config.baseline_mm.map_or(stereo.baseline_m, |mm| mm * 1e-3),
                focal_px: config.focal_px.unwrap_or(stereo.focal_px),
                subpixel_px: config.subpixel_px.unwrap_or(stereo.subpixel_px),
                most_m: config.max_m.unwrap_or(stereo.most_m),
                fattening_px: config.fattening_px.unwrap_or(stereo.fattening_px),
                projector: config.projector.unwrap_or(stereo.projector),
                ..stereo
            }),
            DepthSensor::TimeOfFlight(tof) => {
                let given_hz = config.modulation_mhz.map(|mhz| mhz * 1e6);
                let repeats_m = given_hz.map(|hz| presets::LIGHT_MPS / (2.0 * hz));
                DepthSensor::TimeOfFlight(TimeOfFlight {
                    modulation_hz: given_hz.unwrap_or(tof.modulation_hz),
                    unambiguous_m: config.unambiguous_m.or(repeats_m).unwrap_or(tof.unambiguous_m),
                    least_m: config.min_m.unwrap_or(tof.least_m),
                    most_m: config.max_m.unwrap_or(tof.most_m),
                    signal_e_1m: config.signal_e.unwrap_or(tof.signal_e_1m),
                    background_e: config.background_e.unwrap_or(tof.background_e),
                    multipath: config.multipath.unwrap_or(tof.multipath),
                    ..tof
                })
            }
        })
    }

    /// Returns a short description: `imx219, depth d435`.
    pub fn describe(&self) -> String {
        let depth = self.depth.as_ref().map(|depth| format!("depth {}", depth.model));
        let parts = [self.sensor.clone(), depth];
        let text = parts.into_iter().flatten().collect::<Vec<_>>().join(", ");
        if text.is_empty() { "perfect".to_owned() } else { text }
    }

    /// Checks every value; `key` names a field.
    pub(super) fn check(&self, key: impl Fn(&str) -> String) -> Result<(), ConfigError> {
        let number = |name: &str, value: Option<f64>, unit: &str, range| {
            value.map_or(Ok(()), |value| check_number(&key(name), value, unit, range))
        };
        let of_sensor = [
            ("exposure_ms", self.exposure_ms.is_some()),
            ("gain", self.gain.is_some()),
            ("exposure_lag_s", self.exposure_lag_s.is_some()),
            ("max_exposure_ms", self.max_exposure_ms.is_some()),
            ("max_gain", self.max_gain.is_some()),
            ("illuminance_lx", self.illuminance_lx.is_some()),
            ("f_number", self.f_number.is_some()),
            ("binning", self.binning.is_some()),
            ("full_well_e", self.full_well_e.is_some()),
            ("read_noise_e", self.read_noise_e.is_some()),
            ("readout_ms", self.readout_ms.is_some()),
            ("vignette", self.vignette.is_some()),
            ("filter", self.filter.is_some()),
            ("denoise", self.denoise.is_some()),
            ("noise", self.noise.is_some()),
        ];
        let known = || listed(SENSORS.iter().map(|(name, _)| *name));
        match &self.sensor {
            Some(name) if !SENSORS.iter().any(|(known, _)| known == name) => {
                let advice = format!("unknown; give one of {}", known());
                return Err(invalid(key("sensor"), format!("{name:?}"), advice));
            }
            None => {
                if let Some((name, _)) = of_sensor.iter().find(|(_, given)| *given) {
                    let advice = format!("needs a sensor; add sensor, one of {}", known());
                    return Err(invalid(key(name), "given", advice));
                }
            }
            Some(_) => {}
        }
        number("exposure_ms", self.exposure_ms, "ms", 0.001..=1000.0)?;
        number("gain", self.gain, "", 1.0..=256.0)?;
        if let (Some(gain), None) = (self.gain, self.exposure_ms) {
            let advice = "needs a fixed exposure; give exposure_ms, or max_gain instead";
            return Err(invalid(key("gain"), gain, advice));
        }
        number("exposure_lag_s", self.exposure_lag_s, "s", 0.001..=60.0)?;
        number("max_exposure_ms", self.max_exposure_ms, "ms", 0.02..=1000.0)?;
        number("max_gain", self.max_gain, "", 1.0..=256.0)?;
        number("illuminance_lx", self.illuminance_lx, "lx", 0.001..=200_000.0)?;
        number("f_number", self.f_number, "", 0.7..=32.0)?;
        number("binning", self.binning.map(f64::from), "pixels along each side", 1.0..=64.0)?;
        number("full_well_e", self.full_well_e, "electrons", 100.0..=1e6)?;
        number("read_noise_e", self.read_noise_e, "electrons", 0.0..=1000.0)?;
        number("readout_ms", self.readout_ms, "ms", 0.0..=200.0)?;
        number("vignette", self.vignette, "", 0.0..=0.9)?;
        self.depth
            .as_ref()
            .map_or(Ok(()), |depth| depth.check(|name| key(&format!("depth.{name}"))))
    }
}

impl DepthConfig {
    fn check(&self, key: impl Fn(&str) -> String) -> Result<(), ConfigError> {
        let number = |name: &str, value: Option<f64>, unit: &str, range| {
            value.map_or(Ok(()), |value| check_number(&key(name), value, unit, range))
        };
        let Some((_, preset)) = DEPTHS.iter().find(|(known, _)| *known == self.model) else {
            let names = listed(DEPTHS.iter().map(|(name, _)| *name));
            let advice =
                format!("unknown; give one of {names}, or no depth table for perfect depth");
            return Err(invalid(key("model"), format!("{:?}", self.model), advice));
        };
        let of_stereo = [
            ("baseline_mm", self.baseline_mm.is_some()),
            ("focal_px", self.focal_px.is_some()),
            ("subpixel_px", self.subpixel_px.is_some()),
            ("fattening_px", self.fattening_px.is_some()),
            ("projector", self.projector.is_some()),
        ];
        let of_tof = [
            ("min_m", self.min_m.is_some()),
            ("modulation_mhz", self.modulation_mhz.is_some()),
            ("unambiguous_m", self.unambiguous_m.is_some()),
            ("signal_e", self.signal_e.is_some()),
            ("background_e", self.background_e.is_some()),
            ("multipath", self.multipath.is_some()),
        ];
        let (others, kind) = match preset {
            DepthSensor::Stereo(_) => (&of_tof[..], "a stereo pair"),
            DepthSensor::TimeOfFlight(_) => (&of_stereo[..], "a time-of-flight camera"),
        };
        if let Some((name, _)) = others.iter().find(|(_, given)| *given) {
            let advice = format!("{} is {kind} and does not have this key; remove it", self.model);
            return Err(invalid(key(name), "given", advice));
        }
        number("min_m", self.min_m, "m", 0.0..=100.0)?;
        number("max_m", self.max_m, "m", 0.1..=65.0)?;
        number("baseline_mm", self.baseline_mm, "mm", 1.0..=2000.0)?;
        number("focal_px", self.focal_px, "px", 10.0..=10_000.0)?;
        number("subpixel_px", self.subpixel_px, "px", 0.0..=10.0)?;
        number("fattening_px", self.fattening_px, "px", 0.0..=50.0)?;
        number("modulation_mhz", self.modulation_mhz, "MHz", 0.1..=2000.0)?;
        number("unambiguous_m", self.unambiguous_m, "m", 0.1..=1000.0)?;
        number("signal_e", self.signal_e, "electrons", 1.0..=1e9)?;
        number("background_e", self.background_e, "electrons", 0.0..=1e9)
    }
}

#[cfg(test)]
mod tests;
