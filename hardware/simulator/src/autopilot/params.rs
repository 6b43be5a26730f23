//! ArduCopter parameters that this autopilot implements, by their names in 4.8, and those of `hardware/airframe`.
//!
//! Defaults marked "(lab)" are for a lab (ArduCopter documentation: external navigation, no GPS, no compass); the
//! others are ArduCopter's.

use super::dialect::MavParamType;

/// Name, default, range and type of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParamSpec {
    /// Name, at most 16 characters.
    pub name: &'static str,
    /// Value at boot.
    pub default: f32,
    /// Minimum.
    pub least: f32,
    /// Maximum.
    pub most: f32,
    /// Type on the wire; all values are sent as floats.
    pub kind: MavParamType,
}

macro_rules! params {
    ($($(#[$doc:meta])* $variant:ident = $name:literal, $default:literal, $least:literal..$most:literal, $kind:ident;)*) => {
        /// Parameters by purpose.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Param { $($(#[$doc])* $variant,)* }

        /// All parameters in the order of [`Param`].
        pub const TABLE: &[ParamSpec] = &[$(ParamSpec {
            name: $name,
            default: $default,
            least: $least,
            most: $most,
            kind: MavParamType::$kind,
        },)*];
    };
}

params! {
    /// System ID of the autopilot.
    SystemId = "MAV_SYSID", 1.0, 1.0..255.0, MAV_PARAM_TYPE_INT16;
    /// System ID whose heartbeats count for the ground station failsafe.
    GcsSystemId = "MAV_GCS_SYSID", 255.0, 1.0..255.0, MAV_PARAM_TYPE_INT16;
    /// Frame: 1 is quad.
    FrameClass = "FRAME_CLASS", 1.0, 0.0..20.0, MAV_PARAM_TYPE_INT8;
    /// Frame type: 1 is X.
    FrameType = "FRAME_TYPE", 1.0, 0.0..20.0, MAV_PARAM_TYPE_INT8;
    /// Estimator: 3 is EKF3.
    AhrsEkfType = "AHRS_EKF_TYPE", 3.0, 0.0..11.0, MAV_PARAM_TYPE_INT8;
    /// EKF3 is enabled.
    Ek3Enable = "EK3_ENABLE", 1.0, 0.0..1.0, MAV_PARAM_TYPE_INT8;
    /// Source of horizontal position; 6 is external navigation (lab).
    Ek3PosXy = "EK3_SRC1_POSXY", 6.0, 0.0..6.0, MAV_PARAM_TYPE_INT8;
    /// Source of horizontal velocity (lab).
    Ek3VelXy = "EK3_SRC1_VELXY", 6.0, 0.0..7.0, MAV_PARAM_TYPE_INT8;
    /// Source of height (lab).
    Ek3PosZ = "EK3_SRC1_POSZ", 6.0, 0.0..6.0, MAV_PARAM_TYPE_INT8;
    /// Source of vertical velocity (lab).
    Ek3VelZ = "EK3_SRC1_VELZ", 6.0, 0.0..6.0, MAV_PARAM_TYPE_INT8;
    /// Source of heading (lab).
    Ek3Yaw = "EK3_SRC1_YAW", 6.0, 0.0..8.0, MAV_PARAM_TYPE_INT8;
    /// Compass; none indoors (lab).
    CompassEnable = "COMPASS_ENABLE", 0.0, 0.0..1.0, MAV_PARAM_TYPE_INT8;
    /// GPS; none indoors (lab).
    GpsType = "GPS1_TYPE", 0.0, 0.0..25.0, MAV_PARAM_TYPE_INT8;
    /// Type of external navigation: 1 is MAVLink (lab).
    VisoType = "VISO_TYPE", 1.0, 0.0..3.0, MAV_PARAM_TYPE_INT8;
    /// Constant latency of vision [ms].
    VisoDelayMs = "VISO_DELAY_MS", 10.0, 0.0..250.0, MAV_PARAM_TYPE_INT16;
    /// Minimum standard deviation of vision positions (lab) [m].
    VisoPosNoise = "VISO_POS_M_NSE", 0.1, 0.05..10.0, MAV_PARAM_TYPE_REAL32;
    /// Minimum standard deviation of vision velocities (lab) [m/s].
    VisoVelNoise = "VISO_VEL_M_NSE", 0.1, 0.05..5.0, MAV_PARAM_TYPE_REAL32;
    /// Minimum standard deviation of vision headings (lab) [rad].
    VisoYawNoise = "VISO_YAW_M_NSE", 0.1, 0.05..1.0, MAV_PARAM_TYPE_REAL32;
    /// Speed towards position targets (lab) [m/s].
    WpSpeed = "WP_SPD", 1.0, 0.1..20.0, MAV_PARAM_TYPE_REAL32;
    /// Climb rate towards position targets (lab) [m/s].
    WpSpeedUp = "WP_SPD_UP", 0.5, 0.1..10.0, MAV_PARAM_TYPE_REAL32;
    /// Sink rate towards position targets (lab) [m/s].
    WpSpeedDown = "WP_SPD_DN", 0.5, 0.1..5.0, MAV_PARAM_TYPE_REAL32;
    /// Horizontal acceleration of all guided motion [m/s^2].
    WpAcceleration = "WP_ACC", 2.5, 0.5..10.0, MAV_PARAM_TYPE_REAL32;
    /// Vertical acceleration of all guided motion [m/s^2].
    WpAccelerationZ = "WP_ACC_Z", 1.0, 0.5..8.0, MAV_PARAM_TYPE_REAL32;
    /// Yaw behaviour if a setpoint ignores yaw: 0 keeps it; other values turn the nose into the direction of travel.
    WpYawBehavior = "WP_YAW_BEHAVIOR", 2.0, 0.0..3.0, MAV_PARAM_TYPE_INT8;
    /// Horizontal jerk [m/s^3]; with ArduCopter's default, the response to a velocity takes about 0.7 s.
    JerkHorizontal = "PSC_JERK_NE", 5.0, 1.0..200.0, MAV_PARAM_TYPE_REAL32;
    /// Vertical jerk [m/s^3].
    JerkVertical = "PSC_JERK_D", 5.0, 1.0..200.0, MAV_PARAM_TYPE_REAL32;
    /// Maximum tilt (lab) [deg].
    AngleMax = "ATC_ANGLE_MAX", 45.0, 10.0..60.0, MAV_PARAM_TYPE_REAL32;
    /// Maximum yaw rate towards a target angle (lab) [cdeg/s].
    SlewYaw = "ATC_SLEW_YAW", 12000.0, 500.0..24000.0, MAV_PARAM_TYPE_REAL32;
    /// Timeout of velocity and acceleration setpoints [s].
    GuidTimeout = "GUID_TIMEOUT", 3.0, 0.1..5.0, MAV_PARAM_TYPE_REAL32;
    /// Sink rate near the ground [m/s].
    LandSpeed = "LAND_SPD_MS", 0.5, 0.3..2.0, MAV_PARAM_TYPE_REAL32;
    /// Sink rate above LAND_ALT_LOW_M; 0 uses WP_SPD_DN (lab) [m/s].
    LandSpeedHigh = "LAND_SPD_HIGH_MS", 1.0, 0.0..5.0, MAV_PARAM_TYPE_REAL32;
    /// Height below which the slow sink rate applies (lab) [m].
    LandAltLow = "LAND_ALT_LOW_M", 1.0, 0.5..100.0, MAV_PARAM_TYPE_REAL32;
    /// Height that RTL climbs to first [m]; ArduCopter's default, dangerous in a room.
    RtlAlt = "RTL_ALT_M", 15.0, 0.3..3000.0, MAV_PARAM_TYPE_REAL32;
    /// Time until an armed vehicle on the ground disarms [s]; 0 is never.
    DisarmDelay = "DISARM_DELAY", 10.0, 0.0..127.0, MAV_PARAM_TYPE_INT8;
    /// Action if the ground station is lost: 0 nothing, 1 RTL, 5 LAND (lab).
    FsGcsEnable = "FS_GCS_ENABLE", 5.0, 0.0..7.0, MAV_PARAM_TYPE_INT8;
    /// Silence after which the ground station is lost [s].
    FsGcsTimeout = "FS_GCS_TIMEOUT", 5.0, 2.0..120.0, MAV_PARAM_TYPE_REAL32;
    /// Action if radio control is lost: 0 allows arming without a receiver (lab), 1 RTL, 3 LAND.
    FsThrEnable = "FS_THR_ENABLE", 0.0, 0.0..7.0, MAV_PARAM_TYPE_INT8;
    /// Action if the estimate is lost: 1 lands, 2 holds the height.
    FsEkfAction = "FS_EKF_ACTION", 1.0, 0.0..3.0, MAV_PARAM_TYPE_INT8;
    /// Exceptions: 4 continues in GUIDED without radio control, 8 continues a landing despite further failsafes, 16
    /// (ArduCopter's default) continues pilot control without a ground station.
    FsOptions = "FS_OPTIONS", 16.0, 0.0..63.0, MAV_PARAM_TYPE_INT32;
    /// Silence after which radio control is lost [s].
    RcFsTimeout = "RC_FS_TIMEOUT", 1.0, 0.5..10.0, MAV_PARAM_TYPE_REAL32;
    /// Whether crash detection disarms.
    FsCrashCheck = "FS_CRASH_CHECK", 1.0, 0.0..1.0, MAV_PARAM_TYPE_INT8;
    /// Skips arming checks; here any bit skips all of them.
    ArmingSkipChecks = "ARMING_SKIPCHK", 0.0, -1.0..1048575.0, MAV_PARAM_TYPE_INT32;
    /// Bits of the attitude reference: 16 uses the recorded origin below at boot.
    AhrsOptions = "AHRS_OPTIONS", 0.0, 0.0..65535.0, MAV_PARAM_TYPE_INT16;
    /// Latitude of the recorded origin [deg].
    AhrsOriginLat = "AHRS_ORIGIN_LAT", 0.0, -90.0..90.0, MAV_PARAM_TYPE_REAL32;
    /// Longitude of the recorded origin [deg].
    AhrsOriginLon = "AHRS_ORIGIN_LON", 0.0, -180.0..180.0, MAV_PARAM_TYPE_REAL32;
    /// Altitude of the recorded origin [m].
    AhrsOriginAlt = "AHRS_ORIGIN_ALT", 0.0, -1000.0..10000.0, MAV_PARAM_TYPE_REAL32;
    /// Whether the autopilot's fence around home is enabled.
    FenceEnable = "FENCE_ENABLE", 0.0, 0.0..1.0, MAV_PARAM_TYPE_INT8;
    /// Bits of the fence type: 1 ceiling, 2 circle, 4 polygons, 8 floor.
    FenceType = "FENCE_TYPE", 7.0, 0.0..15.0, MAV_PARAM_TYPE_INT8;
    /// Action at a fence breach: 0 only reports, 1 RTL, 2 LAND, 4 BRAKE.
    FenceAction = "FENCE_ACTION", 1.0, 0.0..5.0, MAV_PARAM_TYPE_INT8;
    /// Ceiling above home [m].
    FenceAltMax = "FENCE_ALT_MAX", 100.0, 0.5..1000.0, MAV_PARAM_TYPE_REAL32;
    /// Floor above home [m].
    FenceAltMin = "FENCE_ALT_MIN", -10.0, -100.0..100.0, MAV_PARAM_TYPE_REAL32;
    /// Radius around home [m].
    FenceRadius = "FENCE_RADIUS", 300.0, 0.5..10000.0, MAV_PARAM_TYPE_REAL32;
    /// Distance of RTL below the ceiling, and height above the floor that activates it [m].
    FenceMargin = "FENCE_MARGIN", 2.0, 0.1..10.0, MAV_PARAM_TYPE_REAL32;
    /// Battery monitor: 4 measures voltage and current (lab).
    BattMonitor = "BATT_MONITOR", 4.0, 0.0..30.0, MAV_PARAM_TYPE_INT8;
    /// Battery capacity [mAh].
    BattCapacity = "BATT_CAPACITY", 850.0, 0.0..100000.0, MAV_PARAM_TYPE_INT32;
    /// Low voltage; 0 is off. Four cells of 3.5 V (lab) [V].
    BattLowVolt = "BATT_LOW_VOLT", 14.0, 0.0..120.0, MAV_PARAM_TYPE_REAL32;
    /// Critical voltage; 0 is off. Four cells of 3.3 V (lab) [V].
    BattCrtVolt = "BATT_CRT_VOLT", 13.2, 0.0..120.0, MAV_PARAM_TYPE_REAL32;
    /// Low remaining charge; 0 is off [mAh].
    BattLowMah = "BATT_LOW_MAH", 0.0, 0.0..100000.0, MAV_PARAM_TYPE_REAL32;
    /// Critical remaining charge; 0 is off [mAh].
    BattCrtMah = "BATT_CRT_MAH", 0.0, 0.0..100000.0, MAV_PARAM_TYPE_REAL32;
    /// Time for which a voltage must be low [s].
    BattLowTimer = "BATT_LOW_TIMER", 10.0, 0.0..120.0, MAV_PARAM_TYPE_INT16;
    /// Action at low battery: 0 only reports, 1 LAND (lab), 2 RTL, 5 motors off, 7 BRAKE.
    BattFsLowAct = "BATT_FS_LOW_ACT", 1.0, 0.0..7.0, MAV_PARAM_TYPE_INT8;
    /// Action at critical battery, with the same values (lab).
    BattFsCrtAct = "BATT_FS_CRT_ACT", 1.0, 0.0..7.0, MAV_PARAM_TYPE_INT8;
    /// Minimum voltage for arming; 0 is off [V].
    BattArmVolt = "BATT_ARM_VOLT", 0.0, 0.0..120.0, MAV_PARAM_TYPE_REAL32;
    /// Hover throttle; reported according to the airframe's thrust-to-weight ratio.
    MotHover = "MOT_THST_HOVER", 0.16, 0.05..0.8, MAV_PARAM_TYPE_REAL32;
}

/// Returns the motion parameters of the file in `hardware/airframe`, as far as this table contains them. The other
/// parameters of the file concern parts that a simulated lab does not have, or sets itself.
pub fn airframe() -> Vec<(String, f32)> {
    const FILE: &str = include_str!("../../../airframe/whippet-copter-4.8.param");
    const MOTION: [&str; 4] = ["WP_", "PSC_", "LAND_", "GUID_"];
    FILE.lines()
        .filter_map(|line| line.split_once(','))
        .filter(|(name, _)| MOTION.iter().any(|group| name.starts_with(group)))
        .filter(|(name, _)| Params::index_of(name).is_some())
        .filter_map(|(name, value)| Some((name.to_owned(), value.trim().parse().ok()?)))
        .collect()
}

/// Present values of all parameters.
#[derive(Clone, Debug)]
pub struct Params {
    values: Vec<f32>,
}

impl Default for Params {
    fn default() -> Self {
        Self { values: TABLE.iter().map(|spec| spec.default).collect() }
    }
}

impl Params {
    pub fn value(&self, param: Param) -> f64 {
        f64::from(self.values[param as usize])
    }

    /// Returns specification and value at an index; `None` if it is out of range.
    pub fn at(&self, index: usize) -> Option<(&'static ParamSpec, f32)> {
        Some((TABLE.get(index)?, *self.values.get(index)?))
    }

    /// Returns the index of a parameter by name.
    pub fn index_of(name: &str) -> Option<usize> {
        TABLE.iter().position(|spec| spec.name == name)
    }

    /// Sets a value, limited to its range and rounded for integer types. A value that is not finite is ignored.
    pub fn set(&mut self, index: usize, value: f32) {
        if let (Some(spec), Some(slot)) = (TABLE.get(index), self.values.get_mut(index))
            && value.is_finite()
        {
            let whole = spec.kind != MavParamType::MAV_PARAM_TYPE_REAL32;
            *slot = if whole { value.round() } else { value }.clamp(spec.least, spec.most);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_valid() {
        for (i, spec) in TABLE.iter().enumerate() {
            assert!(spec.name.len() <= 16, "{}", spec.name);
            assert!((spec.least..=spec.most).contains(&spec.default), "{}", spec.name);
            assert_eq!(Params::index_of(spec.name), Some(i), "{} appears twice", spec.name);
        }
    }

    #[test]
    fn airframe_sets_the_motion_parameters() {
        let set = airframe();
        for name in
            ["PSC_JERK_NE", "PSC_JERK_D", "WP_ACC", "WP_ACC_Z", "GUID_TIMEOUT", "LAND_SPD_MS"]
        {
            assert!(set.iter().any(|(found, _)| found == name), "{name} is not among {set:?}");
        }
    }

    #[test]
    fn values_stay_in_range() {
        let mut params = Params::default();
        let index = Param::GuidTimeout as usize;
        for (given, expected) in [(99.0, 5.0), (f32::NAN, 5.0), (-1.0, 0.1), (2.0, 2.0)] {
            params.set(index, given);
            assert_eq!(params.at(index).unwrap().1, expected);
        }
        params.set(TABLE.len(), 1.0);
        assert!(params.at(TABLE.len()).is_none());
    }
}
