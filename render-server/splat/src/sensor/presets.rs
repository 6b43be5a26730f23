//! Named sensors with the values that their makers publish, and the source of each. Values that a
//! data sheet lacks, or that could not be read, are marked as estimates.
//!
//! Accuracies that a data sheet states as bounds are taken as two standard deviations.

use super::{Beams, LidarModel, RadarModel, RangeModel, Returns, SonarModel};

/// Model of a sensor, by kind.
#[derive(Clone, Debug, PartialEq)]
pub enum Preset {
    /// LiDAR.
    Lidar(LidarModel),
    /// Optical range finder with one beam.
    Range(RangeModel),
    /// Ultrasonic range finder.
    Sonar(SonarModel),
    /// Radar.
    Radar(RadarModel),
}

/// Name in files and on command lines, description, and model of a sensor.
pub type Named = (&'static str, &'static str, fn() -> Preset);

/// All named sensors.
pub const PRESETS: [Named; 12] = [
    ("vlp-16", "Velodyne VLP-16: 16 rings, 30 degrees, 100 m", || Preset::Lidar(vlp_16())),
    ("os1-16", "Ouster OS1-16: 16 x 1024, 33.2 degrees, 120 m", || Preset::Lidar(os1(16))),
    ("os1-64", "Ouster OS1-64: 64 x 1024, 33.2 degrees, 120 m", || Preset::Lidar(os1(64))),
    ("mid-360", "Livox Mid-360: 200 000 points a second, non-repetitive pattern", || {
        Preset::Lidar(mid_360())
    }),
    ("vl53l5cx", "ST VL53L5CX: 8 x 8 zones at once, 4 m", || Preset::Lidar(vl53l5cx())),
    ("ml-30s", "Zvision ML-30s: solid state, 140 x 70 degrees", || Preset::Lidar(ml_30s())),
    ("tfmini", "Benewake TFmini: one beam of 2.3 degrees, 12 m", || Preset::Range(tfmini())),
    ("lidar-lite-v3", "Garmin LIDAR-Lite v3: one beam of 8 mrad, 40 m", || {
        Preset::Range(lidar_lite_v3())
    }),
    ("vl53l1x", "ST VL53L1X: one beam of 27 degrees, 4 m", || Preset::Range(vl53l1x())),
    ("mb1242", "MaxBotix MB1242: ultrasound, 7.65 m", || Preset::Sonar(mb1242())),
    ("hc-sr04", "HC-SR04: ultrasound, 15 degrees, 4 m", || Preset::Sonar(hc_sr04())),
    ("iwr6843", "TI IWR6843 on its EVM: 60 GHz radar, 15 degrees", || Preset::Radar(iwr6843())),
];

/// Returns the model of a named sensor, or `None` if the name is not in [`PRESETS`].
pub fn preset(name: &str) -> Option<Preset> {
    PRESETS.iter().find(|(known, ..)| *known == name).map(|(.., model)| model())
}

/// Returns all names, separated by commas, for help and messages.
pub fn names() -> String {
    PRESETS.map(|(name, ..)| name).join(", ")
}

fn even(count: u32, lowest_deg: f32, highest_deg: f32) -> Vec<f32> {
    let step = (highest_deg - lowest_deg) / (count - 1).max(1) as f32;
    (0..count).map(|n| (highest_deg - step * n as f32).to_radians()).collect()
}

/// Velodyne VLP-16 at 10 Hz (user manual 63-9243 rev D): 16 beams from -15 to 15 degrees, 100 m,
/// accuracy 3 cm typical, ranges in steps of 2 mm, single return. Divergence: as for the same
/// maker's VLS-128 (its manual, table F-1, page 115: 3.0 mrad along the scan, 1.5 mrad across it);
/// the larger value, because beams here are round. The model has 1024 columns instead of 1800, for
/// a cloud of 16 x 1024. The manual states no reflectivity for its range: 100 m at 80 % is an
/// estimate, and so is the resolution of two echoes.
pub fn vlp_16() -> LidarModel {
    LidarModel {
        beams: Beams::Spinning { elevations_rad: even(16, -15.0, 15.0), columns: 1024 },
        rate_hz: 10.0,
        min_range_m: 0.5,
        max_range_m: 100.0,
        divergence_rad: 3.0e-3,
        sigma_m: 0.015,
        sigma_per_m: 0.0,
        range_step_m: 0.002,
        resolution_m: 0.5,
        reference_range_m: 100.0,
        reference_reflectivity: 0.8,
        returns: Returns::Strongest,
    }
}

/// Ouster OS1 of 16 or 64 rings at 1024 x 10 Hz (data sheet of the first OS1, of 850 nm): 33.2
/// degrees, 0.8 to 120 m, 40 m at 10 %, steps of 12 mm, divergence 0.13 degrees at half maximum
/// (1/e^2 at 1.699 times that), strongest return. The standard deviation is 1.5 cm at a good
/// signal, 3 and 10 cm at weaker ones. Its growth by 0.4 mm per metre, the even spacing of the
/// rings and the resolution of two echoes are estimates.
pub fn os1(rings: u32) -> LidarModel {
    LidarModel {
        beams: Beams::Spinning { elevations_rad: even(rings, -16.6, 16.6), columns: 1024 },
        rate_hz: 10.0,
        min_range_m: 0.8,
        max_range_m: 120.0,
        divergence_rad: (0.13_f32 * 1.699).to_radians(),
        sigma_m: 0.015,
        sigma_per_m: 0.0004,
        range_step_m: 0.012,
        resolution_m: 0.5,
        reference_range_m: 40.0,
        reference_reflectivity: 0.1,
        returns: Returns::Strongest,
    }
}

/// Livox Mid-360 (the maker's specification, livoxtech.com/mid-360/specs, as quoted by public
/// simulators): 360 degrees by -7 to 52 degrees, 200 000 points a second in frames of 10 Hz, from
/// 0.1 m, 40 m at 10 % and 70 m at 80 %, standard deviation of at most 2 cm at 10 m, first return.
/// The error of its directions (0.15 degrees) is not modelled. Its scan pattern is not published as
/// a formula. Here, one beam rotates and oscillates in elevation at rates with an irrational
/// ratio. This covers the field with increasing density, as the original does, but along other
/// curves. Divergence (3 mrad), step and the resolution of two echoes are estimates, because no
/// source was found.
pub fn mid_360() -> LidarModel {
    LidarModel {
        beams: Beams::Rosette {
            points: 20_000,
            lowest_rad: (-7_f32).to_radians(),
            highest_rad: 52_f32.to_radians(),
            turns_hz: 20.0,
            // Ratio from the golden ratio: no common period.
            nods_hz: 20.0 * 12.618_033_988_749_895,
        },
        rate_hz: 10.0,
        min_range_m: 0.1,
        max_range_m: 70.0,
        divergence_rad: 3.0e-3,
        sigma_m: 0.02,
        sigma_per_m: 0.0,
        range_step_m: 0.001,
        resolution_m: 0.5,
        reference_range_m: 40.0,
        reference_reflectivity: 0.1,
        returns: Returns::First,
    }
}

/// ST VL53L5CX (DS13754 rev 13: 8 x 8 zones over 45 x 45 degrees, 65 degrees diagonally; vendors
/// state 15 Hz with all zones and 4 m). The cone of a zone is one wide beam. Its errors (5 % beyond
/// 20 cm), minimum range (2 cm) and the reflectivity of 88 % of the white target are estimates,
/// because the tables in the data sheet could not be read.
pub fn vl53l5cx() -> LidarModel {
    let zone_rad = 45_f32.to_radians() / 8.0;
    LidarModel {
        beams: Beams::Flash {
            rows: 8,
            columns: 8,
            horizontal_rad: 7.0 * zone_rad,
            vertical_rad: 7.0 * zone_rad,
        },
        rate_hz: 15.0,
        min_range_m: 0.02,
        max_range_m: 4.0,
        divergence_rad: zone_rad,
        sigma_m: 0.004,
        sigma_per_m: 0.025,
        range_step_m: 0.001,
        resolution_m: 0.6,
        reference_range_m: 4.0,
        reference_reflectivity: 0.88,
        returns: Returns::Strongest,
    }
}

/// Zvision ML-30s (the maker's table for hardware B, as printed in a public guide to mounting it on
/// cranes, and the maker's file for a simulator, `Example_Solid_State_ML30S.json`): 160 lines of
/// 320 points over 140 x 70 degrees at 10 Hz, 0.2 to 45 m, 20 m at 10 % (14 m in the lower 40
/// degrees, which is not modelled), repeatability of 3 cm (one standard deviation), steps of 3 cm,
/// pulses of 6 ns, which are 0.9 m of echo. Its field extends from 50 degrees below to 20 above;
/// here it is level, to be mounted 15 degrees down. The divergence of 5 mrad is an estimate,
/// because no source was found.
pub fn ml_30s() -> LidarModel {
    LidarModel {
        beams: Beams::Raster {
            rows: 160,
            columns: 320,
            horizontal_rad: 140_f32.to_radians(),
            vertical_rad: 70_f32.to_radians(),
        },
        rate_hz: 10.0,
        min_range_m: 0.2,
        max_range_m: 45.0,
        divergence_rad: 5.0e-3,
        sigma_m: 0.03,
        sigma_per_m: 0.0,
        range_step_m: 0.03,
        resolution_m: 0.9,
        reference_range_m: 20.0,
        reference_reflectivity: 0.1,
        returns: Returns::Strongest,
    }
}

/// Benewake TFmini (SJ-GU-TFmini-01 A00, and the same sheet as published by Seeed): 2.3 degrees,
/// 100 Hz, 0.3 to 12 m, 12 m indoors at 90 %, steps of 5 mm, error within 1 % below 6 m. Beyond
/// that, the sheet permits 2 %, which is not modelled; its 5 m at 10 % are 4 m here. The error of 2
/// mm at short range and the resolution of two echoes are estimates.
pub fn tfmini() -> RangeModel {
    RangeModel {
        rate_hz: 100.0,
        fov_rad: 2.3_f32.to_radians(),
        min_range_m: 0.3,
        max_range_m: 12.0,
        sigma_m: 0.002,
        sigma_per_m: 0.005,
        range_step_m: 0.005,
        resolution_m: 0.5,
        reference_range_m: 12.0,
        reference_reflectivity: 0.9,
    }
}

/// Garmin LIDAR-Lite v3 (operation manual and technical specifications, as quoted by a public
/// survey of range finders, and Garmin's product page): 8 mrad, 40 m at 70 %, error 2.5 cm typical
/// below 5 m and 10 cm beyond, steps of 1 cm, 270 readings a second typical, minimum range 5 cm. A
/// standard deviation that grows by 1 mm per metre is half of both errors. The model measures 100
/// times a second. The resolution of two echoes is an estimate.
pub fn lidar_lite_v3() -> RangeModel {
    RangeModel {
        rate_hz: 100.0,
        fov_rad: 8.0e-3,
        min_range_m: 0.05,
        max_range_m: 40.0,
        sigma_m: 0.0125,
        sigma_per_m: 0.001,
        range_step_m: 0.01,
        resolution_m: 1.0,
        reference_range_m: 40.0,
        reference_reflectivity: 0.7,
    }
}

/// ST VL53L1X (DocID031281 rev 2: 27 degrees, up to 4 m and up to 50 Hz). The two exclude each
/// other: 4 m, in the dark on white, take 140 ms per reading, and 20 ms reach 1.3 m (UM2356, as
/// quoted by drivers). From the manual of ST's BlueTile board, which carries one: minimum range 4
/// cm, error 20 mm typical in the dark, white is 88 %. Readings are whole millimetres. The
/// resolution of two echoes is an estimate.
pub fn vl53l1x() -> RangeModel {
    RangeModel {
        rate_hz: 7.0,
        fov_rad: 27_f32.to_radians(),
        min_range_m: 0.04,
        max_range_m: 4.0,
        sigma_m: 0.01,
        sigma_per_m: 0.0,
        range_step_m: 0.001,
        resolution_m: 0.3,
        reference_range_m: 4.0,
        reference_reflectivity: 0.88,
    }
}

/// MaxBotix MB1242 (I2CXL-MaxSonar-EZ4, PD11848): 42 kHz, 15 Hz over the complete range, 20 cm
/// (smaller distances read as 20 cm) to 765 cm, steps of 1 cm. The data sheet shows the beam of
/// this model, the narrowest of the series, only for rods; about 30 degrees for a wide target is an
/// estimate. Absorption at 42 kHz by ISO 9613-1 at 20 degrees and 50 % humidity. The speed of sound
/// changes by 0.17 % per kelvin (0.6 m/s, the maker's PD11500) and is not corrected: 0.3 %, for 2
/// kelvin, is an estimate. Also estimates: another error of half a step, the resolution of two
/// echoes, detection of a wall at 765 cm, and surfaces with slopes of 12 degrees that scatter a
/// twentieth.
pub fn mb1242() -> SonarModel {
    SonarModel {
        rate_hz: 15.0,
        beam_rad: 30_f32.to_radians(),
        min_range_m: 0.2,
        max_range_m: 7.65,
        sigma_m: 0.005,
        sigma_per_m: 0.003,
        range_step_m: 0.01,
        resolution_m: 0.1,
        absorption_db_per_m: 1.4,
        slope_rad: 12_f32.to_radians(),
        diffuse: 0.05,
        reference_range_m: 7.65,
    }
}

/// HC-SR04 (the sheet that sellers of the module publish, "Ultrasonic Ranging Module HC-SR04"):
/// bursts of eight cycles at 40 kHz, which are 3.4 cm of echo, 2 cm to 4 m, 15 degrees, 3 mm, one
/// reading every 60 ms. The 15 degrees are taken as the full angle at -6 dB. Detection of a wall at
/// 4 m, the roughness of surfaces, and the error due to air temperature are estimates.
pub fn hc_sr04() -> SonarModel {
    SonarModel {
        rate_hz: 16.0,
        beam_rad: 15_f32.to_radians(),
        min_range_m: 0.02,
        max_range_m: 4.0,
        sigma_m: 0.003,
        sigma_per_m: 0.003,
        range_step_m: 0.003,
        resolution_m: 0.035,
        absorption_db_per_m: 1.3,
        slope_rad: 12_f32.to_radians(),
        diffuse: 0.05,
        reference_range_m: 4.0,
    }
}

/// TI IWR6843 on an evaluation module. SWRU585 (IWR6843L EVM): 15 degrees of azimuth from 12
/// virtual antennas. TIDUE71D, the 8 m indoor chirp of people counting: 60.75 GHz, a frame every 55
/// ms, resolution of 8.4 cm in range and 0.324 km/h in speed, at most 16.2 km/h and 8.1 m. Its
/// field of view of about 120 x 40 degrees is taken as the angles at -6 dB. With another chirp it
/// tracks people up to 15 m. An SNR of 12 dB for a person (1 m^2) at twice the range of this chirp
/// is an estimate, and so are the minimum range and the surfaces: gamma -10 dB, slopes of 15
/// degrees, a tenth reflected.
pub fn iwr6843() -> RadarModel {
    RadarModel {
        rate_hz: 18.0,
        azimuth_fov_rad: 120_f32.to_radians(),
        elevation_fov_rad: 40_f32.to_radians(),
        min_range_m: 0.1,
        max_range_m: 8.1,
        range_resolution_m: 0.084,
        azimuth_resolution_rad: 15_f32.to_radians(),
        speed_resolution_mps: 0.09,
        max_speed_mps: 4.5,
        reference_range_m: 16.0,
        threshold_db: 12.0,
        gamma: 0.1,
        slope_rad: 15_f32.to_radians(),
        reflectivity: 0.1,
    }
}
