//! Names, units and ranges of ArduCopter's parameters in 4.5, 4.6 and 4.7 to 4.8 (ArduPilot's list of renamed
//! parameters; SYSID_THISMAV as observed on 4.8.0-dev).

use crate::link::Firmware;

/// Generation of parameter names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Version {
    /// ArduCopter 4.5 and older.
    V45,
    /// ArduCopter 4.6.
    V46,
    /// ArduCopter 4.7 and newer.
    V48,
}

impl Version {
    /// All versions.
    pub const ALL: [Self; 3] = [Self::V45, Self::V46, Self::V48];

    /// Returns the generation of names of a firmware.
    pub fn of(firmware: Firmware) -> Self {
        match firmware.version {
            (major, minor, _) if (major, minor) < (4, 6) => Self::V45,
            (4, 6, _) => Self::V46,
            _ => Self::V48,
        }
    }
}

/// Parameter: its names, and the conversion of older values to the newest unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParamSpec {
    /// Name from 4.7 on, used in rules and messages.
    pub name: &'static str,
    /// Name in 4.6; empty if the same as in 4.7.
    pub v46: &'static str,
    /// Name in 4.5; empty if the same as in 4.6.
    pub v45: &'static str,
    /// Factor from the older value to the newest: 0.01 if centimetres became metres.
    pub scale: f64,
    /// Minimum, in the newest unit.
    pub min: f64,
    /// Maximum, in the newest unit.
    pub max: f64,
    /// Whether the value is an integer: an option, a bit mask, a count.
    pub whole: bool,
}

impl ParamSpec {
    /// Returns the name in a version.
    pub fn name_in(&self, version: Version) -> &'static str {
        let v46 = if self.v46.is_empty() { self.name } else { self.v46 };
        match version {
            Version::V48 => self.name,
            Version::V46 => v46,
            Version::V45 if self.v45.is_empty() => v46,
            Version::V45 => self.v45,
        }
    }

    /// Converts a value of a version to the newest unit. The meaning of ARMING_CHECK is inverted.
    pub fn newest(&self, version: Version, value: f64) -> f64 {
        if version == Version::V48 {
            value
        } else if self.name == ARMING {
            f64::from(u8::from(value != 1.0))
        } else {
            value * self.scale
        }
    }

    /// Converts a value in the newest unit to the unit of a version.
    pub fn value_in(&self, version: Version, newest: f64) -> f64 {
        if version == Version::V48 {
            newest
        } else if self.name == ARMING {
            // All checks, or none: the older parameter cannot express the rest.
            f64::from(u8::from(newest == 0.0))
        } else {
            newest / self.scale
        }
    }
}

/// Parameter with inverted bits: checks to skip, in older versions checks to run.
const ARMING: &str = "ARMING_SKIPCHK";

/// Returns the parameter with this name in a version.
pub fn param_spec(version: Version, name: &str) -> Option<&'static ParamSpec> {
    TABLE.iter().find(|spec| spec.name_in(version) == name)
}

/// Option or count.
const fn whole(name: &'static str, min: f64, max: f64) -> ParamSpec {
    ParamSpec { name, v46: "", v45: "", scale: 1.0, min, max, whole: true }
}

/// Measure with the same name in all versions.
const fn real(name: &'static str, min: f64, max: f64) -> ParamSpec {
    ParamSpec { name, v46: "", v45: "", scale: 1.0, min, max, whole: false }
}

/// Measure with another name and unit since 4.7.
const fn renamed(
    name: &'static str,
    v46: &'static str,
    scale: f64,
    min: f64,
    max: f64,
) -> ParamSpec {
    ParamSpec { name, v46, v45: "", scale, min, max, whole: false }
}

const TABLE: &[ParamSpec] = &[
    ParamSpec { v46: "SYSID_THISMAV", ..whole("MAV_SYSID", 1.0, 255.0) },
    ParamSpec { v46: "SYSID_MYGCS", ..whole("MAV_GCS_SYSID", 1.0, 255.0) },
    whole("FRAME_CLASS", 0.0, 17.0),
    whole("FRAME_TYPE", 0.0, 19.0),
    // Estimator and external navigation.
    whole("AHRS_EKF_TYPE", 0.0, 11.0),
    whole("EK3_ENABLE", 0.0, 1.0),
    whole("EK3_SRC1_POSXY", 0.0, 7.0),
    whole("EK3_SRC1_VELXY", 0.0, 7.0),
    whole("EK3_SRC1_POSZ", 0.0, 6.0),
    whole("EK3_SRC1_VELZ", 0.0, 6.0),
    whole("EK3_SRC1_YAW", 0.0, 8.0),
    whole("VISO_TYPE", 0.0, 3.0),
    whole("VISO_DELAY_MS", 0.0, 250.0),
    real("VISO_POS_M_NSE", 0.05, 10.0),
    real("VISO_VEL_M_NSE", 0.05, 5.0),
    real("VISO_YAW_M_NSE", 0.05, 1.0),
    ParamSpec { v45: "GPS_TYPE", ..whole("GPS1_TYPE", 0.0, 26.0) },
    whole("COMPASS_ENABLE", 0.0, 1.0),
    // Failsafes.
    whole("FS_GCS_ENABLE", 0.0, 7.0),
    real("FS_GCS_TIMEOUT", 2.0, 120.0),
    whole("FS_THR_ENABLE", 0.0, 7.0),
    whole("FS_THR_VALUE", 910.0, 1100.0),
    whole("FS_EKF_ACTION", 0.0, 3.0),
    real("FS_EKF_THRESH", 0.0, 1.0),
    whole("FS_DR_ENABLE", 0.0, 6.0),
    whole("FS_CRASH_CHECK", 0.0, 1.0),
    whole("FS_VIBE_ENABLE", 0.0, 1.0),
    whole("FS_OPTIONS", 0.0, 63.0),
    ParamSpec { v46: "ARMING_CHECK", ..whole(ARMING, -1.0, 2_097_151.0) },
    whole("DISARM_DELAY", 0.0, 127.0),
    real("GUID_TIMEOUT", 0.1, 5.0),
    // Fence.
    whole("FENCE_ENABLE", 0.0, 1.0),
    whole("FENCE_TYPE", 0.0, 15.0),
    whole("FENCE_ACTION", 0.0, 5.0),
    real("FENCE_ALT_MAX", 1.0, 1000.0),
    real("FENCE_ALT_MIN", -100.0, 100.0),
    real("FENCE_RADIUS", 1.0, 10_000.0),
    real("FENCE_MARGIN", 0.1, 10.0),
    // Battery.
    whole("BATT_MONITOR", 0.0, 31.0),
    whole("BATT_CAPACITY", 0.0, 100_000.0),
    real("BATT_ARM_VOLT", 0.0, 60.0),
    real("BATT_LOW_VOLT", 0.0, 60.0),
    real("BATT_CRT_VOLT", 0.0, 60.0),
    real("BATT_LOW_MAH", 0.0, 100_000.0),
    real("BATT_CRT_MAH", 0.0, 100_000.0),
    whole("BATT_LOW_TIMER", 0.0, 120.0),
    whole("BATT_FS_LOW_ACT", 0.0, 7.0),
    whole("BATT_FS_CRT_ACT", 0.0, 7.0),
    // Motion.
    renamed("WP_SPD", "WPNAV_SPEED", 0.01, 0.1, 20.0),
    renamed("WP_SPD_UP", "WPNAV_SPEED_UP", 0.01, 0.1, 10.0),
    renamed("WP_SPD_DN", "WPNAV_SPEED_DN", 0.01, 0.1, 5.0),
    renamed("WP_ACC", "WPNAV_ACCEL", 0.01, 0.5, 10.0),
    renamed("WP_ACC_Z", "WPNAV_ACCEL_Z", 0.01, 0.5, 8.0),
    whole("WP_YAW_BEHAVIOR", 0.0, 3.0),
    renamed("ATC_ANGLE_MAX", "ANGLE_MAX", 0.01, 10.0, 80.0),
    renamed("RTL_ALT_M", "RTL_ALT", 0.01, 0.3, 3000.0),
    renamed("RTL_CLIMB_MIN_M", "RTL_CLIMB_MIN", 0.01, 0.0, 30.0),
    renamed("LAND_SPD_MS", "LAND_SPEED", 0.01, 0.3, 2.0),
    renamed("LAND_SPD_HIGH_MS", "LAND_SPEED_HIGH", 0.01, 0.0, 5.0),
    renamed("LAND_ALT_LOW_M", "LAND_ALT_LOW", 0.01, 0.0, 100.0),
    renamed("PILOT_SPD_UP", "PILOT_SPEED_UP", 0.01, 0.1, 5.0),
    renamed("PSC_JERK_NE", "PSC_JERK_XY", 1.0, 1.0, 20.0),
    renamed("PSC_JERK_D", "PSC_JERK_Z", 1.0, 5.0, 50.0),
    // Motors and sensors of the airframe.
    whole("MOT_PWM_TYPE", 0.0, 9.0),
    real("MOT_BAT_VOLT_MAX", 0.0, 53.0),
    real("MOT_BAT_VOLT_MIN", 0.0, 42.0),
    real("MOT_SPIN_ARM", 0.0, 0.3),
    real("MOT_SPIN_MIN", 0.0, 0.3),
    real("MOT_THST_EXPO", -1.0, 1.0),
    real("MOT_THST_HOVER", 0.125, 0.6875),
    whole("SERVO_BLH_AUTO", 0.0, 1.0),
    whole("SERVO1_FUNCTION", -1.0, 190.0),
    whole("SERVO2_FUNCTION", -1.0, 190.0),
    whole("SERVO3_FUNCTION", -1.0, 190.0),
    whole("SERVO4_FUNCTION", -1.0, 190.0),
    whole("SERVO9_FUNCTION", -1.0, 190.0),
    whole("SERVO10_FUNCTION", -1.0, 190.0),
    whole("SERVO11_FUNCTION", -1.0, 190.0),
    whole("SERVO12_FUNCTION", -1.0, 190.0),
    // Parameters for tuning. Ranges from ArduPilot's sources; its tuning guide exceeds them for ATC_RAT_YAW_FLTT (50)
    // and PSC_D_ACC_* (0.02).
    whole("INS_GYRO_FILTER", 0.0, 256.0),
    whole("INS_ACCEL_FILTER", 0.0, 256.0),
    real("ATC_RAT_RLL_FLTD", 0.0, 100.0),
    real("ATC_RAT_RLL_FLTT", 0.0, 100.0),
    real("ATC_RAT_RLL_FLTE", 0.0, 100.0),
    real("ATC_RAT_PIT_FLTD", 0.0, 100.0),
    real("ATC_RAT_PIT_FLTT", 0.0, 100.0),
    real("ATC_RAT_PIT_FLTE", 0.0, 100.0),
    real("ATC_RAT_YAW_FLTT", 0.0, 100.0),
    real("ATC_RAT_YAW_FLTE", 0.0, 20.0),
    real("ATC_RAT_RLL_P", 0.01, 0.5),
    real("ATC_RAT_RLL_I", 0.01, 2.0),
    real("ATC_RAT_RLL_D", 0.0, 0.05),
    real("ATC_RAT_PIT_P", 0.01, 0.5),
    real("ATC_RAT_PIT_I", 0.01, 2.0),
    real("ATC_RAT_PIT_D", 0.0, 0.05),
    renamed("ATC_ACC_R_MAX", "ATC_ACCEL_R_MAX", 0.01, 0.0, 1800.0),
    renamed("ATC_ACC_P_MAX", "ATC_ACCEL_P_MAX", 0.01, 0.0, 1800.0),
    renamed("ATC_ACC_Y_MAX", "ATC_ACCEL_Y_MAX", 0.01, 0.0, 720.0),
    renamed("PSC_D_ACC_P", "PSC_ACCZ_P", 0.1, 0.005, 0.15),
    renamed("PSC_D_ACC_I", "PSC_ACCZ_I", 0.1, 0.01, 0.3),
    // Ports: TELEM1 to the bridge, TELEM2 to the Jetson.
    whole("SERIAL1_PROTOCOL", -1.0, 50.0),
    whole("SERIAL1_BAUD", 1.0, 12_500_000.0),
    whole("SERIAL2_PROTOCOL", -1.0, 50.0),
    whole("SERIAL2_BAUD", 1.0, 12_500_000.0),
    whole("BRD_SER1_RTSCTS", 0.0, 2.0),
    whole("BRD_SER2_RTSCTS", 0.0, 2.0),
    // Transmitter: modes by channel 5, motors off by channel 6.
    whole("FLTMODE_CH", 0.0, 16.0),
    whole("FLTMODE1", 0.0, 28.0),
    whole("FLTMODE4", 0.0, 28.0),
    whole("FLTMODE6", 0.0, 28.0),
    whole("RC6_OPTION", 0.0, 300.0),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_has_valid_ranges_and_unique_names() {
        for version in Version::ALL {
            for (i, row) in TABLE.iter().enumerate() {
                let name = row.name_in(version);
                assert!(name.len() <= 16 && row.min < row.max, "{name}");
                let twice = TABLE[i + 1..].iter().any(|other| other.name_in(version) == name);
                assert!(!twice, "{name} in {version:?}");
            }
        }
    }

    #[test]
    fn names_and_units_follow_the_version() {
        let check = |version, name: &str, value: f64, newest: f64| {
            let spec = param_spec(version, name).unwrap();
            assert!((spec.newest(version, value) - newest).abs() < 1e-9, "{name}");
            assert!((spec.value_in(version, newest) - value).abs() < 1e-9, "{name}");
        };
        check(Version::V45, "WPNAV_SPEED", 100.0, 1.0);
        check(Version::V46, "RTL_ALT", 1500.0, 15.0);
        check(Version::V48, "RTL_ALT_M", 15.0, 15.0);
        check(Version::V45, "GPS_TYPE", 14.0, 14.0);
        check(Version::V46, "ARMING_CHECK", 1.0, 0.0);
        assert!(
            param_spec(Version::V45, "GPS1_TYPE").is_none()
                && param_spec(Version::V46, "GPS1_TYPE").is_some()
        );
        assert!(param_spec(Version::V48, "WPNAV_SPEED").is_none());
        let firmware = |minor| Firmware { name: "ArduCopter", version: (4, minor, 0) };
        assert_eq!(
            [5, 6, 7, 8].map(|minor| Version::of(firmware(minor))),
            [Version::V45, Version::V46, Version::V48, Version::V48]
        );
    }
}
