//! ArduCopter's flight modes.

/// Flight modes of ArduCopter that we name; the number is HEARTBEAT's `custom_mode`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum CopterMode {
    /// Manual attitude.
    Stabilize = 0,
    /// Manual attitude, altitude held.
    AltHold = 2,
    /// Flies what a companion computer asks.
    Guided = 4,
    /// Position held, sticks move it.
    Loiter = 5,
    /// Returns to the launch point; dangerous in a room, it climbs first.
    Rtl = 6,
    /// Comes down here.
    Land = 9,
    /// Stops at once.
    Brake = 17,
}

impl CopterMode {
    /// Returns the mode of a `custom_mode` number, if we name it.
    pub fn from_number(number: u32) -> Option<Self> {
        use CopterMode::{AltHold, Brake, Guided, Land, Loiter, Rtl, Stabilize};
        [Stabilize, AltHold, Guided, Loiter, Rtl, Land, Brake]
            .into_iter()
            .find(|&mode| mode as u32 == number)
    }
}
