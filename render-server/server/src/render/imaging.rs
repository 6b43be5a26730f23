//! Camera effects on rendered images. Pure, with state per camera, so that the render thread (wall clock) and
//! graded flights (virtual clock) have the same effects.
//!
//! ```text
//! perfect image, its camera's config, the vehicle's motion ──▶ CameraEffects ──▶ the image of the camera
//! ```
//! Without `[cameras.imaging]`, the cost is one comparison, and the image is unchanged.

use vizflyt_arena::config::CameraConfig;
use vizflyt_arena::config::imaging::{DepthSensor, FilterKind, ImagingConfig, LightSensor};
use vizflyt_arena::pose::Motion;
use vizflyt_protocol::messages::CameraInfo;
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::imaging::exposure::{Exposure, ExposureControl};
use vizflyt_splat::imaging::mosaic::ColorFilter;
use vizflyt_splat::imaging::noise::NoiseKey;
use vizflyt_splat::imaging::stereo::Stereo;
use vizflyt_splat::imaging::tof::Tof;
use vizflyt_splat::imaging::{CameraModel, DepthModel, Imager, Sensor, Shot};
use vizflyt_splat::{Atmosphere, Camera, RgbdImage};

use crate::render::schedule;

/// Properties of a rendered image that affect the camera effects.
#[derive(Clone, Copy, Debug)]
pub struct EffectInput<'a> {
    /// Settings of the camera.
    pub config: &'a CameraConfig,
    /// Camera as rendered: smaller if the link is slow.
    pub info: &'a CameraInfo,
    /// Motion of the vehicle.
    pub motion: &'a Motion,
    /// Instant and pose of the image.
    pub exposure: schedule::Exposure,
    /// Seeds of the noise: the flight's seed, the camera's index among all, the image's number.
    pub seeds: [u64; 3],
}

/// State of one camera of one vehicle.
#[derive(Debug, Default)]
pub struct CameraEffects {
    /// Settings from which the model was created.
    of: Option<(ImagingConfig, u32)>,
    model: CameraModel,
    imager: Imager,
}

impl CameraEffects {
    /// Applies the camera's effects to a perfect image.
    pub fn apply(&mut self, input: &EffectInput<'_>, image: &mut RgbdImage) {
        let Some(imaging) = &input.config.imaging else { return };
        let width_px = input.info.intrinsics.width_px;
        if self.of.as_ref().is_none_or(|(config, width)| config != imaging || *width != width_px) {
            self.model = camera_model(imaging, width_px);
            self.of = Some((imaging.clone(), width_px));
        }
        let EffectInput { config, info, motion, exposure, seeds: [seed, camera, seq] } = *input;
        let camera_shown = exposure.camera(config, info, Atmosphere::CLEAR);
        let path = |dt_s: f64| motion.at(exposure.at.plus_seconds(dt_s)) * info.body_from_cam;
        let shot = Shot {
            camera: &Camera { world_from_cam: path(0.0), ..camera_shown },
            path: &path,
            at_s: exposure.at.seconds_since(ServerTime::ZERO),
            key: NoiseKey::new(seed, camera, seq),
        };
        self.imager.apply(&self.model, &shot, image);
    }
}

/// Returns the model of a camera with images of this width.
pub fn camera_model(imaging: &ImagingConfig, width_px: u32) -> CameraModel {
    let depth = match imaging.depth_sensor() {
        None => DepthModel::Perfect,
        Some(DepthSensor::Stereo(pair)) => DepthModel::Stereo(Stereo {
            baseline_m: pair.baseline_m,
            focal_px: pair.focal_px,
            subpixel_px: pair.subpixel_px,
            most_disparity_px: pair.most_disparity_px,
            most_m: pair.most_m,
            fattening_px: pair.fattening_px,
            least_texture: if pair.projector { 0.0 } else { LEAST_TEXTURE },
        }),
        Some(DepthSensor::TimeOfFlight(tof)) => DepthModel::Tof(Tof {
            modulation_hz: tof.modulation_hz,
            unambiguous_m: tof.unambiguous_m,
            least_m: tof.least_m,
            most_m: tof.most_m,
            signal_e_1m: tof.signal_e_1m,
            background_e: tof.background_e,
            contrast: tof.contrast,
            least_signal_e: tof.least_signal_e,
            multipath: tof.multipath,
        }),
    };
    CameraModel { sensor: imaging.light_sensor().map(|light| sensor(&light, width_px)), depth }
}

/// Returns a sensor whose pixels match an image of this width.
fn sensor(light: &LightSensor, width_px: u32) -> Sensor {
    let side = f64::from(light.binned(width_px));
    let exposure = match light.fixed_s {
        Some(shutter_s) => ExposureControl::Fixed(Exposure { shutter_s, gain: light.fixed_gain }),
        None => ExposureControl::Auto {
            aim: AIM,
            lag_s: light.lag_s,
            least_shutter_s: light.least_shutter_s.min(light.most_shutter_s),
            most_shutter_s: light.most_shutter_s,
            most_gain: light.most_gain,
        },
    };
    Sensor {
        full_well_e: light.full_well_e * side * side,
        read_noise_e: light.read_noise_e * side,
        electrons_per_s: light.electrons_per_s() * side * side,
        bits: light.bits,
        filter: match light.filter {
            FilterKind::Rgb => ColorFilter::Rgb,
            FilterKind::Bayer => ColorFilter::Bayer,
            FilterKind::Mono => ColorFilter::Mono,
        },
        denoise: light.denoise,
        noise: light.noise,
        vignette: light.vignette,
        readout_s: light.readout_s,
        exposure,
    }
}

/// Target mean linear light of the automatic exposure: 18 % of a grey card (ISO 2720:1974).
const AIM: f64 = 0.18;
/// Minimum contrast of the luminance within 3 x 3 pixels: 2 % is above the noise of a well exposed camera.
const LEAST_TEXTURE: f64 = 0.02;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use vizflyt_arena::config::imaging::{DEPTHS, SENSORS};
    use vizflyt_arena::pose::Predict;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::messages::PoseSample;

    use crate::poses::newest::Localized;

    fn image(config: &CameraConfig) -> RgbdImage {
        let mut image = RgbdImage::default();
        image.resize(config.width_px, config.height_px);
        image.rgb.fill(0.5);
        image.alpha.fill(1.0);
        image.depth_median_m.fill(2.0);
        image.depth_expected_m.fill(2.0);
        image
    }

    fn taken(imaging: Option<&str>, seq: u64) -> RgbdImage {
        let mut config = CameraConfig::ahead("front", [64, 48], 87.0, DVec3::X * 0.1);
        config.imaging = imaging.map(|text| toml::from_str(text).unwrap());
        config.validate().unwrap();
        let stamp = ServerTime::from_ns(1_000_000_000);
        let newest = Localized::still(PoseSample::still(stamp, Pose::IDENTITY));
        let exposure = schedule::Exposure::new(Predict::Measured, None, &newest, stamp);
        let info = config.info();
        let (motion, seeds) = (&newest.motion, [1, 2, seq]);
        let input = EffectInput { config: &config, info: &info, motion, exposure, seeds };
        let mut image = image(&config);
        CameraEffects::default().apply(&input, &mut image);
        image
    }

    #[test]
    fn without_imaging_the_image_is_unchanged() {
        let perfect = image(&CameraConfig::ahead("front", [64, 48], 87.0, DVec3::ZERO));
        assert_eq!(taken(None, 1), perfect);
        assert_eq!(taken(Some(""), 1), perfect);
    }

    #[test]
    fn sensors_and_depth_come_from_the_config() {
        let perfect = taken(None, 1);
        let color = taken(Some("sensor = \"imx219\"\nbinning = 1"), 1);
        assert!(color.rgb != perfect.rgb && color.depth_median_m == perfect.depth_median_m);
        assert_eq!(taken(Some("sensor = \"imx219\"\nbinning = 1"), 1), color, "the same again");
        assert_ne!(taken(Some("sensor = \"imx219\"\nbinning = 1"), 2), color, "another image");
        let depth = taken(Some("depth = { model = \"d435\" }"), 1);
        assert!(depth.rgb == perfect.rgb && depth.depth_median_m != perfect.depth_median_m);
        let grey = taken(Some("sensor = \"ov9281\""), 1);
        assert!(grey.rgb.chunks_exact(3).all(|p| p[0] == p[1] && p[1] == p[2]));
    }

    #[test]
    fn the_page_lists_every_name() {
        let page = include_str!("../web/page/panels/camera_settings.js");
        let quoted = |names: Vec<&str>| {
            names.iter().map(|name| format!("\"{name}\"")).collect::<Vec<_>>().join(", ")
        };
        let sensors = quoted(SENSORS.iter().map(|(name, _)| *name).collect());
        let depths = quoted(DEPTHS.iter().map(|(name, _)| *name).collect());
        assert!(page.contains(&format!("const SENSORS = [{sensors}];")), "{sensors}");
        assert!(page.contains(&format!("const DEPTHS = [{depths}];")), "{depths}");
    }

    #[test]
    fn a_binned_pixel_has_the_sum_of_the_electrons() {
        let config: ImagingConfig = toml::from_str("sensor = \"imx477\"").unwrap();
        let one = camera_model(&config, 4056).sensor.unwrap();
        let joined = camera_model(&config, 338).sensor.unwrap();
        assert!((joined.full_well_e / one.full_well_e - 144.0).abs() < 1e-9);
        assert!((joined.electrons_per_s / one.electrons_per_s - 144.0).abs() < 1e-9);
        assert!((joined.read_noise_e / one.read_noise_e - 12.0).abs() < 1e-9);
    }
}
