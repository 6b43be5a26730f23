//! Named sensors, by the figures that their makers publish, with where each was read. What a data sheet leaves open, or
//! could not be read, is called an estimate where it is filled in.
//!
//! Accuracies that a data sheet states as bounds are taken for two standard deviations.

use super::{Beams, LidarModel, RadarModel, RangeModel, Returns, SonarModel};

/// A sensor's model, by kind.
#[derive(Clone, Debug, PartialEq)]
pub enum Preset {
    /// A LiDAR.
    Lidar(LidarModel),
    /// A range finder of one beam of light.
    Range(RangeModel),
    /// A range finder by sound.
    Sonar(SonarModel),
    /// A radar.
    Radar(RadarModel),
}

/// The name that files and command lines use, what it is, and its model.
pub type Named = (&'static str, &'static str, fn() -> Preset);

/// Every named sensor.
pub const PRESETS: [Named; 12] = [
    ("vlp-16", "Velodyne VLP-16: 16 rings, 30 degrees, 100 m", || Preset::Lidar(vlp_16())),
    ("os1-16", "Ouster OS1-16: 16 x 1024, 33.2 degrees, 120 m", || Preset::Lidar(os1(16))),
    ("os1-64", "Ouster OS1-64: 64 x 1024, 33.2 degrees, 120 m", || Preset::Lidar(os1(64))),
    ("mid-360", "Livox Mid-360: 200 000 points a second, never the same", || {
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

/// Returns the named sensor's model; `None` for a name that is none of [`PRESETS`].
pub fn preset(name: &str) -> Option<Preset> {
    PRESETS.iter().find(|(known, ..)| *known == name).map(|(.., model)| model())
}

/// Returns the names of all, as help and messages list them.
pub fn names() -> String {
    PRESETS.map(|(name, ..)| name).join(", ")
}

fn even(count: u32, lowest_deg: f32, highest_deg: f32) -> Vec<f32> {
    let step = (highest_deg - lowest_deg) / (count - 1).max(1) as f32;
    (0..count).map(|n| (highest_deg - step * n as f32).to_radians()).collect()
}

/// Velodyne VLP-16 at 10 Hz (user manual 63-9243 rev D): 16 beams from -15 to 15 degrees, 100 m, accuracy 3 cm typical,
/// ranges in 2 mm, single return. Divergence: that of the same maker's VLS-128 (its manual, table F-1, page 115: 3.0
/// mrad along the scan, 1.5 mrad across it), the wider of both, for beams here are round. 1024 columns of its 1800, for
/// a cloud of 16 x 1024. The manual names no reflectivity for its range: 100 m at 80 % is an estimate, and so is the
/// resolution of two echoes.
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

/// Ouster OS1 of 16 or 64 rings at 1024 x 10 Hz (data sheet of the first OS1, of 850 nm): 33.2 degrees, 0.8 to 120 m,
/// 40 m at 10 %, steps of 12 mm, divergence 0.13 degrees at half maximum (1/e^2 at 1.699 times that), strongest return.
/// One standard deviation is 1.5 cm at a good signal, 3 and 10 cm at weaker ones: that it grows by 0.4 mm a metre is an
/// estimate, and so are rings that are evenly spaced and the resolution of two echoes.
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

/// Livox Mid-360 (the maker's specification, livoxtech.com/mid-360/specs, as public simulators of it quote): 360 by -7
/// to 52 degrees, 200 000 points a second in frames of 10 Hz, from 0.1 m, 40 m at 10 % and 70 m at 80 %, one standard
/// deviation of at most 2 cm at 10 m, first return. Its directions are within 0.15 degrees, which is not modelled. Its
/// pattern is not published as a formula: here one beam turns and nods at rates whose quotient is irrational, which
/// covers the field ever more densely as the original does, in other curves. Divergence (3 mrad), step and the
/// resolution of two echoes were found nowhere: estimates.
pub fn mid_360() -> LidarModel {
    LidarModel {
        beams: Beams::Rosette {
            points: 20_000,
            lowest_rad: (-7_f32).to_radians(),
            highest_rad: 52_f32.to_radians(),
            turns_hz: 20.0,
            // By the golden ratio: no common period.
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

/// ST VL53L5CX (DS13754 rev 13: 8 x 8 zones over 45 x 45 degrees, 65 across the corners; 15 Hz with all zones and 4 m
/// by vendors' texts). A zone's cone is one wide beam. Its errors (5 % beyond 20 cm), nearest range (2 cm) and the 88 %
/// of the white target are estimates: the sheet's tables of them could not be read.
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

/// Zvision ML-30s (the maker's table for hardware B, as a public guide to fitting it on cranes prints it, and the
/// maker's file for a simulator, `Example_Solid_State_ML30S.json`): 160 lines of 320 points over 140 x 70 degrees at
/// 10 Hz, 0.2 to 45 m, 20 m at 10 % (14 m in the lower 40 degrees, which is not modelled), 3 cm repeated at one
/// standard deviation, steps of 3 cm, pulses of 6 ns, which are 0.9 m of echo. Its field reaches from 50 degrees below
/// to 20 above; here it is level, to be mounted 15 degrees down. Divergence was found nowhere: 5 mrad are an estimate.
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

/// Benewake TFmini (SJ-GU-TFmini-01 A00, and the same sheet as Seeed prints it): 2.3 degrees, 100 Hz, 0.3 to 12 m,
/// 12 m indoors on 90 %, steps of 5 mm, within 1 % below 6 m. From there on the sheet allows 2 %, which is not
/// modelled; its 5 m on 10 % are 4 m here. The 2 mm close by and the resolution of two echoes are estimates.
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

/// Garmin LIDAR-Lite v3 (operation manual and technical specifications, as a public survey of range finders quotes its
/// table, and Garmin's product page): 8 mrad, 40 m on 70 %, 2.5 cm typical below 5 m and 10 cm from there on, steps of
/// 1 cm, 270 readings a second typical; 5 cm at least. A deviation that grows by 1 mm a metre is half of both. Here it
/// is asked 100 times a second. The resolution of two echoes is an estimate.
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

/// ST VL53L1X (DocID031281 rev 2: 27 degrees, up to 4 m and up to 50 Hz). Not both at once: the 4 m, in the dark on
/// white, take 140 ms a reading, and 20 ms reach 1.3 m (UM2356, as drivers quote it). The manual of ST's BlueTile
/// board, which carries one: 4 cm at least, 20 mm typical in the dark, white is 88 %. Readings are whole millimetres.
/// The resolution of two echoes is an estimate.
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

/// MaxBotix MB1242 (I2CXL-MaxSonar-EZ4, PD11848): 42 kHz, 15 Hz over the whole range, 20 cm (nearer reads as 20 cm) to
/// 765 cm, steps of 1 cm. The beam of this narrowest of the series is drawn for rods, not stated: some 30 degrees for a
/// wide target are an estimate. Absorption at 42 kHz by ISO 9613-1 at 20 degrees and half humidity. Sound's speed
/// changes by 0.17 % a kelvin (0.6 m/s, the maker's PD11500) and nothing corrects it: 0.3 %, by 2 kelvin, are an
/// estimate. So are half a step of other error, the resolution of two echoes, that a wall is just heard at 765 cm, and
/// surfaces: slopes of 12 degrees, a twentieth scattered.
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

/// HC-SR04 (the sheet that sellers of the module print, "Ultrasonic Ranging Module HC-SR04"): bursts of eight cycles at
/// 40 kHz, which are 3.4 cm of echo, 2 cm to 4 m, 15 degrees, 3 mm, a reading every 60 ms. What it says of 15 degrees
/// is taken for the full angle at -6 dB. That a wall is just heard at 4 m, how rough surfaces are, and the error by the
/// air's temperature are estimates.
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

/// TI IWR6843 on an evaluation module. SWRU585 (IWR6843L EVM): 15 degrees of azimuth from 12 virtual antennas.
/// TIDUE71D, the 8 m indoor chirp of people counting: 60.75 GHz, a frame every 55 ms, 8.4 cm of range, 16.2 km/h at
/// most, 0.324 km/h of speed, 8.1 m. Its field of view of some 120 x 40 degrees is taken for the angles at -6 dB. It
/// follows people to 15 m with another chirp; that a person (1 m^2) stands out by 12 dB at twice the range of this one
/// is an estimate, and so are the nearest range and surfaces: gamma -10 dB, slopes of 15 degrees, a tenth reflected.
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
