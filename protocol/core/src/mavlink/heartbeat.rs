//! Sender of a HEARTBEAT: the autopilot of a multirotor, the autopilot of another vehicle, or a device.
//!
//! `type` of the heartbeat counts in addition to `autopilot`, because gimbals and antenna trackers also fill in an
//! autopilot, and because ArduPilot's rovers, planes and copters use the same number there.

use super::dialect::{MavAutopilot, MavType};

/// Kind of sender of a HEARTBEAT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeartbeatSender {
    /// Autopilot of a multirotor, with ArduPilot or PX4.
    Multirotor {
        /// Whether the firmware is PX4 instead of ArduPilot.
        px4: bool,
    },
    /// Autopilot of another type of vehicle, or with another firmware. VizFlyt does not fly it.
    OtherVehicle,
    /// Gimbal, camera, companion computer, ground station or another component.
    Device,
}

/// Component of an autopilot: MAV_COMP_ID_AUTOPILOT1.
const AUTOPILOT1: u8 = 1;

/// Returns the sender of a HEARTBEAT from its component and the fields `type` and `autopilot`.
///
/// Helicopters and VTOLs are no multirotors: parameters, take-off and LAND assume ArduCopter's or PX4's multirotors.
pub const fn heartbeat_sender(component: u8, mavtype: u8, autopilot: u8) -> HeartbeatSender {
    const INVALID: u8 = MavAutopilot::MAV_AUTOPILOT_INVALID as u8;
    if component != AUTOPILOT1 || autopilot == INVALID {
        return HeartbeatSender::Device;
    }
    let px4 = autopilot == MavAutopilot::MAV_AUTOPILOT_PX4 as u8;
    if is_multirotor(mavtype)
        && (px4 || autopilot == MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA as u8)
    {
        return HeartbeatSender::Multirotor { px4 };
    }
    if is_device(mavtype) { HeartbeatSender::Device } else { HeartbeatSender::OtherVehicle }
}

const fn is_multirotor(mavtype: u8) -> bool {
    // QUADROTOR, COAXIAL, HEXAROTOR, OCTOROTOR, TRICOPTER, DODECAROTOR, DECAROTOR, GENERIC_MULTIROTOR.
    matches!(mavtype, 2 | 3 | 13..=15 | 29 | 35 | 43)
}

const fn is_device(mavtype: u8) -> bool {
    // GCS, ONBOARD_CONTROLLER, GIMBAL, ADSB, CAMERA to ODID, BATTERY to WINCH, ILLUMINATOR, GRIPPER, RADIO.
    matches!(mavtype, 6 | 18 | 26 | 27 | 30..=34 | 36..=42 | 44 | 48 | 49)
}

/// Component of a bridge: MAV_COMP_ID_UDP_BRIDGE.
const BRIDGE: u8 = 240;

/// Returns the name of a sender of a HEARTBEAT, with its article.
pub fn heartbeat_sender_name(component: u8, mavtype: MavType) -> &'static str {
    match mavtype as u8 {
        0 if component == AUTOPILOT1 => "a vehicle of unknown type",
        0 if component == BRIDGE => "a bridge",
        1 => "a plane",
        2 => "a quadrotor",
        3 => "a coaxial rotorcraft",
        4 => "a helicopter",
        5 => "an antenna tracker",
        6 => "a ground station",
        7 => "an airship",
        8 => "a balloon",
        9 => "a rocket",
        10 => "a rover",
        11 => "a boat",
        12 => "a submarine",
        13 => "a hexarotor",
        14 => "an octorotor",
        15 => "a tricopter",
        16 => "a flapping wing",
        17 => "a kite",
        18 => "a companion computer",
        19..=25 | 47 => "a VTOL aircraft",
        26 => "a gimbal",
        27 => "an ADS-B receiver",
        28 => "a parafoil",
        29 => "a dodecarotor",
        30 => "a camera",
        31 => "a charging station",
        32 => "a FLARM receiver",
        33 => "a servo",
        34 => "a remote ID transmitter",
        35 => "a decarotor",
        36 => "a battery",
        37 => "a parachute",
        38 => "a logger",
        39 => "an OSD",
        40 => "an IMU",
        41 => "a GPS receiver",
        42 => "a winch",
        43 => "a multirotor",
        44 => "an illuminator",
        45 => "a spacecraft",
        46 => "a walking robot",
        48 => "a gripper",
        49 => "a radio",
        _ => "a device of unknown type",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Exactly the multirotors of component 1 with ArduPilot or PX4 count, for every value of every field.
    #[test]
    fn only_multirotors_of_component_1_are_autopilots() {
        use MavType::*;
        let multirotors = [
            MAV_TYPE_QUADROTOR,
            MAV_TYPE_COAXIAL,
            MAV_TYPE_HEXAROTOR,
            MAV_TYPE_OCTOROTOR,
            MAV_TYPE_TRICOPTER,
            MAV_TYPE_DODECAROTOR,
            MAV_TYPE_DECAROTOR,
            MAV_TYPE_GENERIC_MULTIROTOR,
        ];
        for component in 0..=u8::MAX {
            for mavtype in 0..=u8::MAX {
                for autopilot in 0..=u8::MAX {
                    let counts = component == 1
                        && multirotors.iter().any(|known| *known as u8 == mavtype)
                        && matches!(autopilot, 3 | 12);
                    let sender = heartbeat_sender(component, mavtype, autopilot);
                    let expected = HeartbeatSender::Multirotor { px4: autopilot == 12 };
                    assert_eq!(sender == expected, counts, "{component} {mavtype} {autopilot}");
                    let is_multirotor = matches!(sender, HeartbeatSender::Multirotor { .. });
                    assert_eq!(is_multirotor, counts);
                }
            }
        }
    }

    #[test]
    fn distinguishes_vehicles_from_devices() {
        use MavType::*;
        let sender = |component, mavtype| heartbeat_sender(component, mavtype as u8, 3);
        for vehicle in [
            MAV_TYPE_GENERIC,
            MAV_TYPE_FIXED_WING,
            MAV_TYPE_HELICOPTER,
            MAV_TYPE_ANTENNA_TRACKER,
            MAV_TYPE_GROUND_ROVER,
            MAV_TYPE_SURFACE_BOAT,
            MAV_TYPE_SUBMARINE,
            MAV_TYPE_VTOL_FIXEDROTOR,
        ] {
            assert_eq!(sender(1, vehicle), HeartbeatSender::OtherVehicle, "{vehicle:?}");
            assert_eq!(sender(154, vehicle), HeartbeatSender::Device, "{vehicle:?}");
        }
        for device in [
            MAV_TYPE_GCS,
            MAV_TYPE_ONBOARD_CONTROLLER,
            MAV_TYPE_GIMBAL,
            MAV_TYPE_ADSB,
            MAV_TYPE_CAMERA,
            MAV_TYPE_ODID,
            MAV_TYPE_BATTERY,
            MAV_TYPE_WINCH,
            MAV_TYPE_RADIO,
        ] {
            assert_eq!(sender(1, device), HeartbeatSender::Device, "{device:?}");
        }
        assert_eq!(heartbeat_sender(1, 2, 0), HeartbeatSender::OtherVehicle, "another firmware");
        assert_eq!(heartbeat_sender(1, 2, 8), HeartbeatSender::Device, "no autopilot");
        let name = heartbeat_sender_name;
        assert_eq!(name(1, MAV_TYPE_GROUND_ROVER), "a rover");
        assert_eq!(name(1, MAV_TYPE_VTOL_TILTWING), "a VTOL aircraft");
        assert_eq!(name(1, MAV_TYPE_GENERIC), "a vehicle of unknown type");
        assert_eq!(name(240, MAV_TYPE_GENERIC), "a bridge");
        assert_eq!(name(154, MAV_TYPE_GENERIC), "a device of unknown type");
    }
}
