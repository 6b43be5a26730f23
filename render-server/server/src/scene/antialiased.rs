//! `--antialiased`: whether a scene is rendered as one that was trained with anti-aliasing.

use std::fmt;

use clap::ValueEnum;
use vizflyt_splat::Splats;

/// Values of `--antialiased`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Antialiased {
    /// As `scene.antialiased` of the arena says, else the scene's file; many do not.
    #[default]
    Auto,
    /// Trained with anti-aliasing: mip-splatting, splatfacto's and gsplat's `antialiased`, brush's `mip`.
    On,
    /// Trained in the classic way.
    Off,
}

impl Antialiased {
    /// Decides how splats are rendered.
    pub fn apply(self, splats: &mut Splats) {
        splats.antialiased = match self {
            Self::Auto => splats.antialiased,
            Self::On => true,
            Self::Off => false,
        };
    }
}

/// As the command line spells it, for those who pass it on.
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
    fn the_file_decides_unless_it_is_overruled() {
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
