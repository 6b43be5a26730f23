//! Classifies pixels by the colour of the racing windows.
//!
//! The colours of the course's windows are known. Hue distinguishes the windows; saturation excludes brick, mats and
//! grey steel. Light changes the value strongly, but the hue only a little.

/// Colours of the course's windows, and of the hand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColorClass {
    /// Red bars, white arrowheads.
    Red,
    /// Blue bars, yellow arrowheads.
    Blue,
    /// Magenta bars, black arrowheads.
    Magenta,
    /// Orange bars, black arrowheads: the window with the hand.
    Orange,
    /// The hand.
    Teal,
}

impl ColorClass {
    /// The colour classes of windows.
    pub const WINDOWS: [Self; 4] = [Self::Red, Self::Blue, Self::Magenta, Self::Orange];

    /// Returns the class of an sRGB pixel, or `None`.
    pub fn of(rgb: [u8; 3]) -> Option<Self> {
        let [r, g, b] = rgb.map(i32::from);
        let (most, least) = (r.max(g).max(b), r.min(g).min(b));
        let chroma = most - least;
        if most < DARKEST || chroma * 100 < SATURATION * most {
            return None;
        }
        let sixth = |a: i32, b: i32| 60 * (a - b) / chroma;
        let hue_deg = if most == r {
            (sixth(g, b) + 360) % 360
        } else if most == g {
            sixth(b, r) + 120
        } else {
            sixth(r, g) + 240
        };
        match hue_deg {
            342..360 | 0..6 => Some(Self::Red),
            20..40 => Some(Self::Orange),
            164..188 => Some(Self::Teal),
            205..240 => Some(Self::Blue),
            306..336 => Some(Self::Magenta),
            _ => None,
        }
    }
}

/// Darker pixels have no reliable hue: the noise of a JPEG is about 5. Of 255.
const DARKEST: i32 = 45;
/// Bars have at least 70 %, brick and floor mats at most 55 %. [%]
const SATURATION: i32 = 60;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_classes_are_distinct_from_each_other_and_from_the_hall() {
        let check = |rgb: u32, expected: Option<ColorClass>| {
            let [_, r, g, b] = rgb.to_be_bytes();
            for light in [30, 60, 100] {
                let lit = [r, g, b].map(|c| (u32::from(c) * light / 100) as u8);
                let dark = lit.iter().max().is_some_and(|&most| i32::from(most) < DARKEST);
                assert_eq!(
                    ColorClass::of(lit),
                    expected.filter(|_| !dark),
                    "{rgb:06x} at {light} %"
                );
            }
        };
        check(0xd8_1f2a, Some(ColorClass::Red));
        check(0x1f_54d8, Some(ColorClass::Blue));
        check(0xe0_218a, Some(ColorClass::Magenta));
        check(0xf0_8a12, Some(ColorClass::Orange));
        check(0x12_b5a6, Some(ColorClass::Teal));
        // Arrowheads, chequers, steel, floor mats, plaster, brick.
        for rgb in [0xf2_d21f, 0xf6_f2ea, 0x12_1214, 0x8b_8e93, 0x4a_6f94, 0xca_bfae, 0x8a_4a36] {
            check(rgb, None);
        }
    }
}
