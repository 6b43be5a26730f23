//! The example plugins that are linked into `vizflyt`: their names. `vizflyt plugin NAME` runs one.

use clap::ValueEnum;

/// A plugin that is linked into this program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BuiltIn {
    /// Flies to the goal through obstacles, by a potential field on the depth image.
    Avoid,
    /// Flies windows, a gap and a rotating hand from images alone.
    Race,
}

impl BuiltIn {
    /// Returns the names of all, as the command line takes them.
    pub fn names() -> String {
        let values = Self::value_variants().iter().filter_map(ValueEnum::to_possible_value);
        values.map(|value| value.get_name().to_owned()).collect::<Vec<_>>().join(", ")
    }

    /// Returns the built-in of this name.
    pub fn find(name: &str) -> Option<Self> {
        Self::from_str(name, true).ok()
    }
}
