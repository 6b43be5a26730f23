//! ArduCopter's flight modes.

/// Flight modes of ArduCopter that VizFlyt uses. The number is `custom_mode` of HEARTBEAT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum CopterMode {
    /// Manual attitude.
    Stabilize = 0,
    /// Manual attitude, altitude held.
    AltHold = 2,
    /// Follows setpoints of a companion computer.
    Guided = 4,
    /// Position hold; the sticks move the position.
    Loiter = 5,
    /// Returns to the launch point. Dangerous in a room, because it climbs first.
    Rtl = 6,
    /// Lands at the current position.
    Land = 9,
    /// Stops as fast as possible.
    Brake = 17,
}

impl CopterMode {
    /// Returns the mode of a `custom_mode` number, if it is one of these.
    pub fn from_number(number: u32) -> Option<Self> {
        use CopterMode::{AltHold, Brake, Guided, Land, Loiter, Rtl, Stabilize};
        [Stabilize, AltHold, Guided, Loiter, Rtl, Land, Brake]
            .into_iter()
            .find(|&mode| mode as u32 == number)
    }
}
