//! Chip-specific inputs of a bridge.

/// Identity of the chip, and its entropy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Chip {
    /// MAC address of the radio.
    pub address: [u8; 6],
    /// Random bytes, fresh at each start and unpredictable.
    pub random: [u8; 16],
}
