//! Ids of this runtime, and the autopilot's firmware.

/// System id of the runtime. ArduCopter's ground station failsafe counts its heartbeats (`MAV_GCS_SYSID`, default 255).
pub const SYSTEM_ID: u8 = 255;
/// Component id of the runtime: MAV_COMP_ID_ONBOARD_COMPUTER.
pub const COMPONENT_ID: u8 = 191;

/// Firmware of an autopilot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Firmware {
    /// `ArduCopter` or `PX4`.
    pub name: &'static str,
    /// Major, minor, patch.
    pub version: (u8, u8, u8),
}

impl std::fmt::Display for Firmware {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (major, minor, patch) = self.version;
        write!(f, "{} {major}.{minor}.{patch}", self.name)
    }
}
