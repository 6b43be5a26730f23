//! Sensors with a name, by what is published of them.
//!
//! Light is counted in photopic units: a lux on a square micrometre makes `4090 quantum_efficiency` electrons a second, that is 1/683
//! W/m^2 of photons of 555 nm. The efficiency is of white light behind the sensor's own filters.

use super::FilterKind;

/// An image sensor behind a lens; of a pixel of the sensor, not of the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightSensor {
    /// Side of a pixel. [um]
    pub pixel_um: f64,
    /// Pixels across.
    pub columns: u32,
    /// Pixels of the sensor that one of the image joins, along each side; without it by the image's width.
    pub binning: Option<u32>,
    /// Electrons per photon of white light.
    pub quantum_efficiency: f64,
    /// Most electrons that a pixel holds. [e]
    pub full_well_e: f64,
    /// Of reading a pixel, standard deviation. [e]
    pub read_noise_e: f64,
    /// Bits of the converter.
    pub bits: u32,
    /// From the first row's exposure to the last one's; 0 is a global shutter. [s]
    pub readout_s: f64,
    /// What lies before the pixels.
    pub filter: FilterKind,
    /// The lens's.
    pub f_number: f64,
    /// Share of the light that the corners lack.
    pub vignette: f64,
    /// Light that falls onto the scene. [lx]
    pub illuminance_lx: f64,
    /// A fixed shutter. [s]
    pub fixed_s: Option<f64>,
    /// The gain that goes with it.
    pub fixed_gain: f64,
    /// Time constant of the automatic exposure. [s]
    pub lag_s: f64,
    /// Its shortest shutter. [s]
    pub least_shutter_s: f64,
    /// Its longest shutter. [s]
    pub most_shutter_s: f64,
    /// Its greatest gain.
    pub most_gain: f64,
    /// Whether images are denoised.
    pub denoise: bool,
    /// Whether there is noise.
    pub noise: bool,
}

impl LightSensor {
    /// Returns how many pixels of the sensor one of an image joins along each side.
    pub fn binned(&self, width_px: u32) -> u32 {
        self.binning.unwrap_or(self.columns / width_px.max(1)).max(1)
    }

    /// Returns the electrons that white makes in a pixel of the sensor in a second: the lens lets `T / (4 N^2)` of the scene's
    /// illuminance onto the sensor (of a diffuse white, far away). [e/s]
    pub fn electrons_per_s(&self) -> f64 {
        let on_sensor_lx = self.illuminance_lx * TRANSMISSION / (4.0 * self.f_number.powi(2));
        on_sensor_lx * ELECTRONS * self.quantum_efficiency * self.pixel_um.powi(2)
    }
}

/// A depth camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DepthSensor {
    /// By disparity.
    Stereo(StereoPair),
    /// By the time that light takes.
    TimeOfFlight(TimeOfFlight),
}

/// A stereo pair; as `vizflyt_splat::imaging::stereo` has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPair {
    /// Between the cameras. [m]
    pub baseline_m: f64,
    /// Focal length of the images that are matched. [px]
    pub focal_px: f64,
    /// Standard deviation of a disparity. [px]
    pub subpixel_px: f64,
    /// Greatest disparity that is searched. [px]
    pub most_disparity_px: f64,
    /// Nothing further is reported. [m]
    pub most_m: f64,
    /// How far what is in front reaches over what is behind. [px]
    pub fattening_px: f64,
    /// Whether blank walls have a texture.
    pub projector: bool,
}

/// A time-of-flight camera; as `vizflyt_splat::imaging::tof` has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeOfFlight {
    /// Modulation that the noise is of. [Hz]
    pub modulation_hz: f64,
    /// Distance from which on distances repeat. [m]
    pub unambiguous_m: f64,
    /// Nothing nearer is reported. [m]
    pub least_m: f64,
    /// Nothing further is reported. [m]
    pub most_m: f64,
    /// Electrons of its own light that white makes 1 m ahead. [e]
    pub signal_e_1m: f64,
    /// Electrons of other light. [e]
    pub background_e: f64,
    /// How much of the modulation is left.
    pub contrast: f64,
    /// Pixels with less signal are no return. [e]
    pub least_signal_e: f64,
    /// Whether light that comes by way of other surfaces counts.
    pub multipath: bool,
}

/// Sony's IMX219, of the Raspberry Pi camera 2.
///
/// Pixel, sensitivity and converter from the data sheet of the IMX219PQH5-C (table 46: 205 of 1023 numbers at 706 cd/m^2, F2.8,
/// 1/120 s in green: 0.59 lx s make a fifth of full scale). Rows: 3448 clocks of 182.4 MHz (Linux, `drivers/media/i2c/imx219.c`),
/// 18.9 us, of 1232 joined rows. Full well and read noise are not published: 3400 electrons per um^2 and 3 electrons are those
/// measured of the IMX477, its maker's next. The efficiency follows from sensitivity and full well. Lens F2.0.
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
    // The data sheet's shading of 70 %, of its own lens.
    vignette: 0.3,
    illuminance_lx: OFFICE_LX,
    fixed_s: None,
    fixed_gain: 1.0,
    lag_s: LAG_S,
    least_shutter_s: 18.9e-6,
    most_shutter_s: LONGEST_S,
    // 256 / (256 - 232), the driver's greatest.
    most_gain: 10.67,
    denoise: false,
    noise: true,
};

/// The image sensors that have a name.
pub const SENSORS: &[(&str, LightSensor)] = &[
    ("imx219", IMX219),
    // Sony's IMX477, of the Raspberry Pi High Quality Camera. Pixel, full well 8180 e, read noise 3 e at gain 1, gains to 16 as
    // measured by J. Hofmann, "Pi HQ Cam Sensor Performance", strollswithmydog.com. Rows: 12740 clocks of 840 MHz, 15.2 us, of 1520
    // joined rows (Linux, imx477.c). Efficiency as of the IMX219. Lens F2.8, of many that fit.
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
    // OmniVision's OV5647, of the Raspberry Pi camera 1: 1.4 um, 4.3 ke, SNR 36 dB, dynamic range 68 dB (as the user guide of the
    // OptArc AF51 quotes the data sheet): 4300 / 10^(68 / 20) = 1.7 e. Rows: 972 of 30 a second at most, 2 x 2 joined.
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
    // OmniVision's OV9281, global shutter, 3 um, 1280 x 800, grey (docs.luxonis.com, OV9282; lens F2.0). Full well and read noise are
    // not published: those of the IMX296 by area. An efficiency of 0.6 has most of the green light without a colour filter.
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
    // Sony's IMX296, of the Raspberry Pi Global Shutter Camera: 3.45 um, 1456 x 1088. Full well and noise of the IMX255, whose pixel is
    // the same: SNR 40.3 dB, dynamic range 71.3 dB (manual of Matrix Vision's mvBlueFOX3): 10^4.03 = 10700 e, over 10^(71.3 / 20) = 2.9 e.
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

/// The depth cameras that have a name.
pub const DEPTHS: &[(&str, DepthSensor)] = &[
    // Intel's RealSense D435 at 848 x 480, the best by Intel's "Tuning depth cameras for best performance": baseline 50 mm, 87 degrees
    // (424 / tan 43.5 = 446.8 px), 126 disparities, 10 m, subpixel 0.08 px as of a well tuned one.
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
    // Microsoft's Azure Kinect, narrow field of view: 0.5 to 3.86 m, standard deviation at most 17 mm (learn.microsoft.com, "Azure
    // Kinect DK hardware specifications"), to which the signal is set at 3.86 m: a camera at its published bound. 200 MHz and what is
    // left of the modulation at it from C. S. Bamji et al., ISSCC 2018. It unwraps several frequencies; nothing repeats in range.
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
    // ESPROS' TOFcam 635: 0.1 to 7.5 m on white (its manual), which is half the wave of 20 MHz: distances repeat at 7.49 m. Noise is not
    // published: 1 % at 3 m is assumed.
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
/// Photons of 555 nm a second on a square micrometre in a lux: 1e-12 / (683 * 3.579e-19).
const ELECTRONS: f64 = 4090.0;
/// Of a lens of some coated elements.
const TRANSMISSION: f64 = 0.9;
/// Offices are lit with 500 lx (EN 12464-1). [lx]
const OFFICE_LX: f64 = 500.0;
/// Settles within a second, as phones' and libcamera's do. [s]
const LAG_S: f64 = 0.35;
/// At 30 images a second. [s]
const LONGEST_S: f64 = 0.033;
