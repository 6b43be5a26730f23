//! `--antialiased`: whether the scene was trained with anti-aliasing.

use std::fmt;

use clap::ValueEnum;
use vizflyt_splat::Splats;

/// Values of `--antialiased`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Antialiased {
    /// From the arena's `scene.antialiased`, else from the scene's file
    ///
    /// Many files do not state it.
    #[default]
    Auto,
    /// Trained with anti-aliasing (mip-splatting)
    ///
    /// Also `antialiased` of splatfacto and gsplat, and `mip` of brush.
    On,
    /// Trained without anti-aliasing
    Off,
}

impl Antialiased {
    /// Sets whether splats are rendered with anti-aliasing.
    pub fn apply(self, splats: &mut Splats) {
        splats.antialiased = match self {
            Self::Auto => splats.antialiased,
            Self::On => true,
            Self::Off => false,
        };
    }
}

/// The value on the command line.
impl fmt::Display for Antialiased {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::On => "on",
            Self::Off => "off",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_decides_unless_overridden() {
        let check = |choice: Antialiased, file: bool, expected: bool| {
            let mut splats = Splats { antialiased: file, ..Splats::default() };
            choice.apply(&mut splats);
            assert_eq!(splats.antialiased, expected, "{choice}, file {file}");
            assert_eq!(Antialiased::from_str(&choice.to_string(), false), Ok(choice));
        };
        for file in [false, true] {
            check(Antialiased::Auto, file, file);
            check(Antialiased::On, file, true);
            check(Antialiased::Off, file, false);
        }
    }
}
