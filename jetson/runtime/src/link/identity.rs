//! Who is who on the link.

/// Our system id: the one whose heartbeats ArduCopter's ground station failsafe counts
/// (`MAV_GCS_SYSID`, default 255).
pub const SYSTEM_ID: u8 = 255;
/// Our component: MAV_COMP_ID_ONBOARD_COMPUTER.
pub const COMPONENT_ID: u8 = 191;

/// An autopilot's firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Firmware {
    /// ArduCopter or PX4.
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
