//! Named environments.

use glam::DVec3;

use super::{
    CloudConfig, EnvironmentConfig, FOG, FlickerConfig, LampsConfig, OwnLightConfig, RainConfig,
    SnowConfig, SunConfig,
};

/// A night without a lamp: a thirtieth of the light.
const NIGHT: [f64; 3] = [0.20, 0.23, 0.34];

impl EnvironmentConfig {
    /// Named environments: the one table that the page, the command line and their messages list. To add one,
    /// add a row; a test checks it.
    ///
    /// Light is a factor on display values: a value of 0.5 stands for a fifth of the light, 0.22 for a
    /// thirtieth. Visibility in fog is 12 m, in rooms of 11 m: the far wall is a shadow.
    pub const NAMED: &'static [(&'static str, Self)] = &[
        ("day", Self::CLEAR),
        ("dusk", Self { light: [0.62, 0.48, 0.42], ..Self::CLEAR }),
        ("night", Self { light: NIGHT, ..Self::CLEAR }),
        ("fog", Self { fog_visibility_m: 12.0, ..Self::CLEAR }),
        (
            "night-fog",
            Self {
                light: NIGHT,
                fog_visibility_m: 12.0,
                fog: [FOG[0] * NIGHT[0], FOG[1] * NIGHT[1], FOG[2] * NIGHT[2]],
                ..Self::CLEAR
            },
        ),
        (
            "patchy-fog",
            Self {
                cloud: Some(CloudConfig { visibility_m: 16.0, patch_m: 5.0, ..CloudConfig::USUAL }),
                ..Self::CLEAR
            },
        ),
        (
            "smoke",
            Self {
                cloud: Some(CloudConfig {
                    visibility_m: 12.0,
                    color: [0.34, 0.34, 0.35],
                    patch_m: 1.6,
                    drift_mps: DVec3::new(0.25, 0.1, 0.15),
                    ..CloudConfig::USUAL
                }),
                ..Self::CLEAR
            },
        ),
        (
            "dust",
            Self {
                light: [1.0, 0.94, 0.82],
                cloud: Some(CloudConfig {
                    visibility_m: 8.0,
                    color: [0.66, 0.55, 0.41],
                    patch_m: 2.0,
                    drift_mps: DVec3::new(0.9, 0.4, 0.05),
                    layer_m: Some([-1.0, 1.4]),
                    ..CloudConfig::USUAL
                }),
                ..Self::CLEAR
            },
        ),
        (
            "rain",
            Self {
                light: [0.72, 0.76, 0.80],
                exposure_ms: 2.0,
                rain: Some(RainConfig { rate_mmph: 60.0, ..RainConfig::USUAL }),
                ..Self::CLEAR
            },
        ),
        (
            "night-rain",
            Self {
                light: NIGHT,
                rain: Some(RainConfig { rate_mmph: 60.0, ..RainConfig::USUAL }),
                own_light: Some(OwnLightConfig::USUAL),
                fog: [FOG[0] * NIGHT[0], FOG[1] * NIGHT[1], FOG[2] * NIGHT[2]],
                ..Self::CLEAR
            },
        ),
        (
            "snow",
            Self {
                light: [0.86, 0.90, 0.96],
                snow: Some(SnowConfig { rate_mmph: 4.0, ..SnowConfig::USUAL }),
                ..Self::CLEAR
            },
        ),
        (
            "low-sun",
            Self {
                light: [1.0, 0.86, 0.66],
                sun: Some(SunConfig { behind_m: 6.0, ..SunConfig::USUAL }),
                ..Self::CLEAR
            },
        ),
        ("lamps", Self { light: NIGHT, lamps: Some(LampsConfig::USUAL), ..Self::CLEAR }),
        ("own-light", Self { light: NIGHT, own_light: Some(OwnLightConfig::USUAL), ..Self::CLEAR }),
        (
            "night-snow",
            Self {
                light: NIGHT,
                snow: Some(SnowConfig { rate_mmph: 4.0, ..SnowConfig::USUAL }),
                fog: [FOG[0] * NIGHT[0], FOG[1] * NIGHT[1], FOG[2] * NIGHT[2]],
                own_light: Some(OwnLightConfig::USUAL),
                ..Self::CLEAR
            },
        ),
        (
            "tubes",
            Self {
                light: [0.92, 1.0, 0.90],
                exposure_ms: 2.0,
                flicker: Some(FlickerConfig::USUAL),
                ..Self::CLEAR
            },
        ),
    ];
}
