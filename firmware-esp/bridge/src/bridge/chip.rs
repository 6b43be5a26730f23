//! The chip that a bridge runs on.

/// What a bridge knows of the chip it runs on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Chip {
    /// The radio's address.
    pub address: [u8; 6],
    /// Random bytes of this start: nobody guesses the next.
    pub random: [u8; 16],
}
