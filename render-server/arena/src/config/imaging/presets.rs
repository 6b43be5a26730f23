//! Named sensors, from published values.
//!
//! Light is counted in photopic units: 1 lux on a square micrometre produces `4090 quantum_efficiency`
//! electrons per second, that is 1/683 W/m^2 of photons of 555 nm. The efficiency is for white light behind the
//! sensor's own filters.

use super::FilterKind;

/// Image sensor with a lens; values are per pixel of the sensor, not of the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightSensor {
    /// Pixel pitch. [um]
    pub pixel_um: f64,
    /// Width of the sensor in pixels.
    pub columns: u32,
    /// Sensor pixels per image pixel, along each side; if absent, from the image's width.
    pub binning: Option<u32>,
    /// Electrons per photon of white light.
    pub quantum_efficiency: f64,
    /// Full-well capacity. [e]
    pub full_well_e: f64,
    /// Read noise, one standard deviation. [e]
    pub read_noise_e: f64,
    /// Resolution of the analogue-digital converter in bits.
    pub bits: u32,
    /// Time from the first row's exposure to the last row's; 0 for a global shutter. [s]
    pub readout_s: f64,
    /// Colour filter.
    pub filter: FilterKind,
    /// F-number of the lens.
    pub f_number: f64,
    /// Share of the light that is lost in the corners.
    pub vignette: f64,
    /// Illuminance of the scene. [lx]
    pub illuminance_lx: f64,
    /// Shutter time of a fixed exposure. [s]
    pub fixed_s: Option<f64>,
    /// Gain of a fixed exposure.
    pub fixed_gain: f64,
    /// Time constant of the automatic exposure. [s]
    pub lag_s: f64,
    /// Minimum shutter time of the automatic exposure. [s]
    pub least_shutter_s: f64,
    /// Maximum shutter time of the automatic exposure. [s]
    pub most_shutter_s: f64,
    /// Maximum gain of the automatic exposure.
    pub most_gain: f64,
    /// Whether the camera denoises its images.
    pub denoise: bool,
    /// Whether to simulate photon noise and read noise.
    pub noise: bool,
}

impl LightSensor {
    /// Returns the number of sensor pixels per image pixel, along each side.
    pub fn binned(&self, width_px: u32) -> u32 {
        self.binning.unwrap_or(self.columns / width_px.max(1)).max(1)
    }

    /// Returns the electrons per second that white produces in a sensor pixel: the lens passes `T / (4 N^2)` of
    /// the scene's illuminance to the sensor (for a distant, diffuse white surface). [e/s]
    pub fn electrons_per_s(&self) -> f64 {
        let on_sensor_lx = self.illuminance_lx * TRANSMISSION / (4.0 * self.f_number.powi(2));
        on_sensor_lx * ELECTRONS * self.quantum_efficiency * self.pixel_um.powi(2)
    }
}

/// A depth camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DepthSensor {
    /// Measures disparity.
    Stereo(StereoPair),
    /// Measures time of flight.
    TimeOfFlight(TimeOfFlight),
}

/// Stereo pair; parameters of `vizflyt_splat::imaging::stereo`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPair {
    /// Distance between the cameras. [m]
    pub baseline_m: f64,
    /// Focal length of the images that are matched. [px]
    pub focal_px: f64,
    /// Disparity noise, one standard deviation. [px]
    pub subpixel_px: f64,
    /// Maximum disparity of the search. [px]
    pub most_disparity_px: f64,
    /// Maximum reported distance. [m]
    pub most_m: f64,
    /// Foreground fattening: width by which near objects extend over the background. [px]
    pub fattening_px: f64,
    /// Whether a projector adds texture to blank walls.
    pub projector: bool,
}

/// Time-of-flight camera; parameters of `vizflyt_splat::imaging::tof`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeOfFlight {
    /// Modulation frequency that determines the noise. [Hz]
    pub modulation_hz: f64,
    /// Unambiguous range: beyond it, distances restart at 0. [m]
    pub unambiguous_m: f64,
    /// Minimum reported distance. [m]
    pub least_m: f64,
    /// Maximum reported distance. [m]
    pub most_m: f64,
    /// Signal of the camera's own light, reflected by a white surface at 1 m. [e]
    pub signal_e_1m: f64,
    /// Signal of ambient light. [e]
    pub background_e: f64,
    /// Modulation contrast, 0 to 1.
    pub contrast: f64,
    /// Minimum signal of a valid pixel; others have no return. [e]
    pub least_signal_e: f64,
    /// Whether to simulate multipath: light that arrives by way of other surfaces.
    pub multipath: bool,
}

/// Sony IMX219, the sensor of the Raspberry Pi Camera 2.
///
/// Pixel, sensitivity and converter are from the data sheet of the IMX219PQH5-C (table 46: 205 of 1023 numbers
/// at 706 cd/m^2, F2.8, 1/120 s in green: 0.59 lx s make a fifth of full scale). Rows: 3448 clocks of 182.4 MHz
/// (Linux, `drivers/media/i2c/imx219.c`), 18.9 us, of 1232 joined rows. Full well and read noise are not
/// published: 3400 electrons per um^2 and 3 electrons were measured for the IMX477, the maker's next model. The
/// efficiency follows from sensitivity and full well. Lens F2.0.
const IMX219: LightSensor = LightSensor {
    pixel_um: 1.12,
    columns: 3280,
    binning: None,
    quantum_efficiency: 0.28,
    full_well_e: 4265.0,
    read_noise_e: 3.0,
    bits: 10,
    readout_s: 1232.0 * 3448.0 / 182.4e6,
    filter: FilterKind::Rgb,
    f_number: 2.0,
    // The data sheet's shading is 70 %, for the module's own lens.
    vignette: 0.3,
    illuminance_lx: OFFICE_LX,
    fixed_s: None,
    fixed_gain: 1.0,
    lag_s: LAG_S,
    least_shutter_s: 18.9e-6,
    most_shutter_s: LONGEST_S,
    // 256 / (256 - 232), the driver's maximum.
    most_gain: 10.67,
    denoise: false,
    noise: true,
};

/// Named image sensors.
pub const SENSORS: &[(&str, LightSensor)] = &[
    ("imx219", IMX219),
    // Sony IMX477, the sensor of the Raspberry Pi High Quality Camera. Pixel, full well 8180 e, read noise 3 e
    // at gain 1, gains up to 16: measured by J. Hofmann, "Pi HQ Cam Sensor Performance", strollswithmydog.com.
    // Rows: 12740 clocks of 840 MHz, 15.2 us, of 1520 joined rows (Linux, imx477.c). Efficiency of the IMX219.
    // Lens F2.8, one of many that fit.
    (
        "imx477",
        LightSensor {
            pixel_um: 1.55,
            columns: 4056,
            full_well_e: 8180.0,
            bits: 12,
            readout_s: 1520.0 * 12740.0 / 840e6,
            f_number: 2.8,
            vignette: 0.2,
            least_shutter_s: 15.2e-6,
            most_gain: 16.0,
            ..IMX219
        },
    ),
    // OmniVision OV5647, the sensor of the Raspberry Pi Camera 1: 1.4 um, 4.3 ke, SNR 36 dB, dynamic range 68
    // dB (the user guide of the OptArc AF51 quotes the data sheet): 4300 / 10^(68 / 20) = 1.7 e. Rows: 972 at
    // up to 30 Hz, 2 x 2 joined.
    (
        "ov5647",
        LightSensor {
            pixel_um: 1.4,
            columns: 2592,
            full_well_e: 4300.0,
            read_noise_e: 1.7,
            readout_s: 0.021,
            f_number: 2.9,
            least_shutter_s: 21e-6,
            most_gain: 15.5,
            ..IMX219
        },
    ),
    // OmniVision OV9281, global shutter, 3 um, 1280 x 800, grey (docs.luxonis.com, OV9282; lens F2.0). Full
    // well and read noise are not published: scaled from the IMX296 by area. An efficiency of 0.6 means most of
    // the green light, without a colour filter.
    (
        "ov9281",
        LightSensor {
            pixel_um: 3.0,
            columns: 1280,
            quantum_efficiency: 0.6,
            full_well_e: 8100.0,
            read_noise_e: 2.9,
            bits: 10,
            readout_s: 0.0,
            filter: FilterKind::Mono,
            f_number: 2.0,
            least_shutter_s: 10e-6,
            most_gain: 16.0,
            ..IMX219
        },
    ),
    // Sony IMX296, the sensor of the Raspberry Pi Global Shutter Camera: 3.45 um, 1456 x 1088. Full well and
    // noise of the IMX255, which has the same pixel: SNR 40.3 dB, dynamic range 71.3 dB (manual of Matrix
    // Vision's mvBlueFOX3): 10^4.03 = 10700 e, over 10^(71.3 / 20) = 2.9 e.
    (
        "imx296",
        LightSensor {
            pixel_um: 3.45,
            columns: 1456,
            quantum_efficiency: 0.28,
            full_well_e: 10_700.0,
            read_noise_e: 2.9,
            bits: 10,
            readout_s: 0.0,
            f_number: 2.8,
            vignette: 0.2,
            least_shutter_s: 29e-6,
            most_gain: 16.0,
            ..IMX219
        },
    ),
];

/// Named depth cameras.
pub const DEPTHS: &[(&str, DepthSensor)] = &[
    // Intel RealSense D435 at 848 x 480, the best mode according to Intel's "Tuning depth cameras for best
    // performance": baseline 50 mm, 87 degrees (424 / tan 43.5 = 446.8 px), 126 disparities, 10 m, subpixel
    // 0.08 px (well tuned).
    (
        "d435",
        DepthSensor::Stereo(StereoPair {
            baseline_m: 0.05,
            focal_px: 446.8,
            subpixel_px: 0.08,
            most_disparity_px: 126.0,
            most_m: 10.0,
            fattening_px: 3.0,
            projector: true,
        }),
    ),
    // Microsoft Azure Kinect, narrow field of view: 0.5 to 3.86 m, standard deviation at most 17 mm
    // (learn.microsoft.com, "Azure Kinect DK hardware specifications"). The signal is chosen to reach this
    // published bound at 3.86 m. 200 MHz and the modulation contrast are from C. S. Bamji et al., ISSCC 2018.
    // The camera unwraps several frequencies; distances do not repeat within its range.
    (
        "azure-kinect",
        DepthSensor::TimeOfFlight(TimeOfFlight {
            modulation_hz: 200e6,
            unambiguous_m: 25.0,
            least_m: 0.5,
            most_m: 3.86,
            signal_e_1m: 1940.0,
            background_e: 0.0,
            contrast: 0.87,
            least_signal_e: 10.0,
            multipath: true,
        }),
    ),
    // ESPROS TOFcam 635: 0.1 to 7.5 m on white (manual), half the wavelength of 20 MHz: distances repeat at
    // 7.49 m. Noise is not published; 1 % at 3 m is assumed.
    (
        "tofcam-635",
        DepthSensor::TimeOfFlight(TimeOfFlight {
            modulation_hz: 20e6,
            unambiguous_m: LIGHT_MPS / 40e6,
            least_m: 0.1,
            most_m: 7.5,
            signal_e_1m: 44_500.0,
            background_e: 0.0,
            contrast: 0.8,
            least_signal_e: 100.0,
            multipath: true,
        }),
    ),
];

/// Speed of light. [m/s]
pub(super) const LIGHT_MPS: f64 = 299_792_458.0;
/// Photons of 555 nm per second, per square micrometre and lux: 1e-12 / (683 * 3.579e-19).
const ELECTRONS: f64 = 4090.0;
/// Transmission of a lens with several coated elements.
const TRANSMISSION: f64 = 0.9;
/// Office lighting (EN 12464-1). [lx]
const OFFICE_LX: f64 = 500.0;
/// Settles within a second, as in phones and libcamera. [s]
const LAG_S: f64 = 0.35;
/// For 30 images per second. [s]
const LONGEST_S: f64 = 0.033;
