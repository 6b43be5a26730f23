//! Names of the built-in example plugins. `vizflyt plugin NAME` runs one.

use clap::ValueEnum;

/// A plugin that is linked into this program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BuiltIn {
    /// Flies to the goal through obstacles, with a potential field on the depth image
    Avoid,
    /// Flies through windows and a gap and past a rotating hand, with images only
    Race,
}

impl BuiltIn {
    /// Returns all names, as on the command line.
    pub fn names() -> String {
        let values = Self::value_variants().iter().filter_map(ValueEnum::to_possible_value);
        values.map(|value| value.get_name().to_owned()).collect::<Vec<_>>().join(", ")
    }

    /// Returns the built-in plugin of this name.
    pub fn find(name: &str) -> Option<Self> {
        Self::from_str(name, true).ok()
    }
}
