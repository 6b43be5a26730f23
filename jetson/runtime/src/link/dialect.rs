//! Differences between autopilots: ArduCopter in GUIDED, PX4 in OFFBOARD. One trait, so that the link has the same code
//! for both. Outside this module, modes are ArduCopter's numbers.

use std::collections::BTreeMap;
use std::fmt::Debug;

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::mavlink::dialect::MavParamType;

use super::params::Param;
use crate::guard::Response;

/// Message to stream: id and period. [us]
pub(super) type Interval = (u32, f32);

/// Take-off procedure of an autopilot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Rise {
    /// MAV_CMD_NAV_TAKEOFF after arming.
    ByCommand,
    /// A setpoint above the ground, streamed before the mode change.
    BySetpoint,
}

/// Properties of an autopilot.
pub(super) trait Dialect: Debug + Send + Sync {
    fn name(&self) -> &'static str;
    /// Name of the mode in which it follows setpoints.
    fn follow(&self) -> &'static str;
    /// Returns ArduCopter's number for HEARTBEAT's `custom_mode`.
    fn mode(&self, custom_mode: u32) -> u32;
    /// Returns parameters 2 and 3 of MAV_CMD_DO_SET_MODE.
    fn mode_parameters(&self, mode: CopterMode) -> (f32, f32);
    /// Returns the take-off procedure.
    fn rise(&self) -> Rise;
    /// Whether the autopilot needs SET_GPS_GLOBAL_ORIGIN before it has a position.
    fn needs_origin(&self) -> bool;
    /// Whether the autopilot enforces fence polygons when it flies by external navigation.
    fn keeps_polygons(&self) -> bool;
    /// Advice if the estimator has no position.
    fn navigation_advice(&self) -> &'static str;
    /// Name of the parameter for external navigation's latency in milliseconds.
    fn delay_parameter(&self) -> &'static str;
    /// Returns the vehicle's response to velocities according to its parameters; `None` if they are missing.
    fn response(&self, known: &BTreeMap<String, Param>) -> Option<Response>;
    /// Parameters relevant for flight safety, read at every connection.
    fn watched(&self) -> &'static [&'static str];
    /// Requested message streams.
    fn intervals(&self) -> &'static [Interval];
    /// Returns a parameter's value from the wire.
    fn value_from_wire(&self, value: f32, kind: MavParamType) -> f64;
    /// Returns a parameter's value for the wire.
    fn value_to_wire(&self, value: f64, kind: MavParamType) -> f32;
}

/// Returns the dialect of PX4 or ArduCopter.
pub(super) fn of(px4: bool) -> &'static dyn Dialect {
    if px4 { &Px4 } else { &ArduCopter }
}

/// ArduCopter 4.5 and later.
#[derive(Debug)]
pub(super) struct ArduCopter;

impl Dialect for ArduCopter {
    fn name(&self) -> &'static str {
        "ArduCopter"
    }

    fn follow(&self) -> &'static str {
        "GUIDED"
    }

    fn mode(&self, custom_mode: u32) -> u32 {
        custom_mode
    }

    fn mode_parameters(&self, mode: CopterMode) -> (f32, f32) {
        (mode as u32 as f32, 0.0)
    }

    fn rise(&self) -> Rise {
        Rise::ByCommand
    }

    fn needs_origin(&self) -> bool {
        true
    }

    fn keeps_polygons(&self) -> bool {
        true
    }

    fn navigation_advice(&self) -> &'static str {
        "external navigation needs VISO_TYPE=1 and EK3_SRC1_* = 6"
    }

    fn delay_parameter(&self) -> &'static str {
        "VISO_DELAY_MS"
    }

    /// Names and units changed with ArduCopter 4.7.
    fn response(&self, known: &BTreeMap<String, Param>) -> Option<Response> {
        let value = |name: &str| known.get(name).map(|param| param.value);
        let jerk_mps3 = value("PSC_JERK_NE").or_else(|| value("PSC_JERK_XY"))?;
        let acceleration_mps2 =
            value("WP_ACC").or_else(|| value("WPNAV_ACCEL").map(|cmss| cmss / 100.0))?;
        Some(Response::of_ardupilot(jerk_mps3, acceleration_mps2))
    }

    fn watched(&self) -> &'static [&'static str] {
        &[
            "VISO_TYPE",
            "VISO_DELAY_MS",
            "PSC_JERK_NE",
            "PSC_JERK_XY",
            "WP_ACC",
            "WPNAV_ACCEL",
            "EK3_SRC1_POSXY",
            "EK3_SRC1_YAW",
            "FS_GCS_ENABLE",
            "FS_EKF_ACTION",
            "BATT_MONITOR",
            "BATT_FS_LOW_ACT",
            "BATT_FS_CRT_ACT",
            "FENCE_ENABLE",
            "FENCE_TYPE",
            "FENCE_ACTION",
        ]
    }

    fn intervals(&self) -> &'static [Interval] {
        &[
            (30, 20_000.0),   // ATTITUDE
            (27, 10_000.0),   // RAW_IMU: 4 kB/s, which a serial link still carries
            (32, 20_000.0),   // LOCAL_POSITION_NED
            (193, 200_000.0), // EKF_STATUS_REPORT
            (1, 500_000.0),   // SYS_STATUS
        ]
    }

    fn value_from_wire(&self, value: f32, _: MavParamType) -> f64 {
        f64::from(value)
    }

    fn value_to_wire(&self, value: f64, _: MavParamType) -> f32 {
        value as f32
    }
}

/// PX4 1.13 and later.
#[derive(Debug)]
pub(super) struct Px4;

/// PX4's main modes (px4_custom_mode.h); sub-modes of AUTO follow.
mod px4 {
    pub(super) const MANUAL: u32 = 1;
    pub(super) const ALTITUDE: u32 = 2;
    pub(super) const POSITION: u32 = 3;
    pub(super) const AUTO: u32 = 4;
    pub(super) const OFFBOARD: u32 = 6;
    pub(super) const STABILIZED: u32 = 7;
    pub(super) const AUTO_LOITER: u32 = 3;
    pub(super) const AUTO_RTL: u32 = 5;
    pub(super) const AUTO_LAND: u32 = 6;
}

impl Dialect for Px4 {
    fn name(&self) -> &'static str {
        "PX4"
    }

    fn follow(&self) -> &'static str {
        "OFFBOARD"
    }

    fn mode(&self, custom_mode: u32) -> u32 {
        let (main, sub) = (custom_mode >> 16 & 0xFF, custom_mode >> 24);
        match (main, sub) {
            (px4::OFFBOARD, _) => CopterMode::Guided as u32,
            (px4::AUTO, px4::AUTO_LAND) => CopterMode::Land as u32,
            (px4::AUTO, px4::AUTO_RTL) => CopterMode::Rtl as u32,
            (px4::POSITION, _) | (px4::AUTO, px4::AUTO_LOITER) => CopterMode::Loiter as u32,
            (px4::ALTITUDE, _) => CopterMode::AltHold as u32,
            (px4::MANUAL | px4::STABILIZED, _) => CopterMode::Stabilize as u32,
            // Larger than all of ArduCopter's mode numbers, so that they cannot be confused.
            _ => custom_mode | 1 << 15,
        }
    }

    fn mode_parameters(&self, mode: CopterMode) -> (f32, f32) {
        let (main, sub) = match mode {
            CopterMode::Guided => (px4::OFFBOARD, 0),
            CopterMode::Land => (px4::AUTO, px4::AUTO_LAND),
            CopterMode::Rtl => (px4::AUTO, px4::AUTO_RTL),
            CopterMode::Brake => (px4::AUTO, px4::AUTO_LOITER),
            CopterMode::Loiter => (px4::POSITION, 0),
            CopterMode::AltHold => (px4::ALTITUDE, 0),
            CopterMode::Stabilize => (px4::STABILIZED, 0),
        };
        (main as f32, sub as f32)
    }

    fn rise(&self) -> Rise {
        Rise::BySetpoint
    }

    fn needs_origin(&self) -> bool {
        false
    }

    /// PX4 checks its fence against the global position, which external navigation does not provide.
    fn keeps_polygons(&self) -> bool {
        false
    }

    fn navigation_advice(&self) -> &'static str {
        "external navigation needs EKF2_EV_CTRL=11 and EKF2_HGT_REF=3"
    }

    fn delay_parameter(&self) -> &'static str {
        "EKF2_EV_DELAY"
    }

    /// The parameters do not give it; the guard measures it in flight.
    fn response(&self, _: &BTreeMap<String, Param>) -> Option<Response> {
        None
    }

    fn watched(&self) -> &'static [&'static str] {
        &["EKF2_EV_CTRL", "EKF2_EV_DELAY", "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "NAV_DLL_ACT"]
    }

    fn intervals(&self) -> &'static [Interval] {
        &[
            (30, 20_000.0),   // ATTITUDE
            (105, 10_000.0),  // HIGHRES_IMU
            (32, 20_000.0),   // LOCAL_POSITION_NED
            (230, 200_000.0), // ESTIMATOR_STATUS
            (1, 500_000.0),   // SYS_STATUS
        ]
    }

    /// PX4 stores the bits of an integer in the float field (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE).
    fn value_from_wire(&self, value: f32, kind: MavParamType) -> f64 {
        let bits = value.to_bits();
        match kind {
            MavParamType::MAV_PARAM_TYPE_UINT8 => f64::from(bits as u8),
            MavParamType::MAV_PARAM_TYPE_INT8 => f64::from(bits as i8),
            MavParamType::MAV_PARAM_TYPE_UINT16 => f64::from(bits as u16),
            MavParamType::MAV_PARAM_TYPE_INT16 => f64::from(bits as i16),
            MavParamType::MAV_PARAM_TYPE_UINT32 => f64::from(bits),
            MavParamType::MAV_PARAM_TYPE_INT32 => f64::from(bits.cast_signed()),
            _ => f64::from(value),
        }
    }

    fn value_to_wire(&self, value: f64, kind: MavParamType) -> f32 {
        match kind {
            MavParamType::MAV_PARAM_TYPE_UINT8
            | MavParamType::MAV_PARAM_TYPE_UINT16
            | MavParamType::MAV_PARAM_TYPE_UINT32 => f32::from_bits(value as u32),
            MavParamType::MAV_PARAM_TYPE_INT8 => {
                f32::from_bits(u32::from((value as i8).cast_unsigned()))
            }
            MavParamType::MAV_PARAM_TYPE_INT16 => {
                f32::from_bits(u32::from((value as i16).cast_unsigned()))
            }
            MavParamType::MAV_PARAM_TYPE_INT32 => f32::from_bits((value as i32).cast_unsigned()),
            _ => value as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn px4_modes_convert_to_arducopter_modes_and_back() {
        use CopterMode::{AltHold, Brake, Guided, Land, Loiter, Rtl, Stabilize};
        for mode in [Stabilize, AltHold, Guided, Loiter, Rtl, Land] {
            let (main, sub) = Px4.mode_parameters(mode);
            let custom_mode = (main as u32) << 16 | (sub as u32) << 24;
            assert_eq!(Px4.mode(custom_mode), mode as u32, "{mode:?}");
        }
        // PX4 has no Brake; it loiters.
        assert_eq!(Px4.mode_parameters(Brake), (4.0, 3.0));
        assert!(CopterMode::from_number(Px4.mode(4 << 16 | 4 << 24)).is_none(), "a mission");
    }

    #[test]
    fn px4_integers_are_sent_as_bits() {
        use MavParamType::{
            MAV_PARAM_TYPE_INT8, MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32, MAV_PARAM_TYPE_UINT16,
        };
        let check = |value: f64, kind| {
            assert_eq!(Px4.value_from_wire(Px4.value_to_wire(value, kind), kind), value);
        };
        check(-3.0, MAV_PARAM_TYPE_INT32);
        check(2_000_000_011.0, MAV_PARAM_TYPE_INT32);
        check(-128.0, MAV_PARAM_TYPE_INT8);
        check(65_535.0, MAV_PARAM_TYPE_UINT16);
        check(0.25, MAV_PARAM_TYPE_REAL32);
        assert_eq!(Px4.value_to_wire(11.0, MAV_PARAM_TYPE_INT32).to_bits(), 11);
        assert_eq!(ArduCopter.value_to_wire(11.0, MAV_PARAM_TYPE_INT32), 11.0);
    }
}
