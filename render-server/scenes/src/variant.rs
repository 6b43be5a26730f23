//! The same place in another light: what a plugin must cope with besides the seed.

use core::fmt;
use core::str::FromStr;

use vizflyt_splat::Splats;

use crate::Generated;

/// How a place is lit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Variant {
    /// As painted.
    #[default]
    Day,
    /// Half as bright, and warm.
    Dusk,
    /// A fifth as bright, and blue.
    Night,
}

impl Variant {
    /// Every variant.
    pub const ALL: [Self; 3] = [Self::Day, Self::Dusk, Self::Night];

    /// Returns the variant's name as the command line takes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Day => "day",
            Self::Dusk => "dusk",
            Self::Night => "night",
        }
    }

    /// Puts a place in this light. Geometry, course and rules stay.
    pub(crate) fn apply(self, generated: &mut Generated) {
        let gain = match self {
            Self::Day => return,
            // Of display values: a value of 0.5 stands for a fifth of the light, 0.22 for a thirtieth.
            Self::Dusk => [0.62, 0.48, 0.42],
            Self::Night => [0.20, 0.23, 0.34],
        };
        light(&mut generated.splats, gain);
        for object in &mut generated.objects {
            light(&mut object.splats, gain);
        }
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Variant {
    type Err = UnknownVariant;

    fn from_str(text: &str) -> Result<Self, UnknownVariant> {
        let known = Self::ALL.into_iter().find(|variant| variant.name() == text);
        known.ok_or_else(|| UnknownVariant(text.to_owned()))
    }
}

/// A name that is no [`Variant`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no variant is called '{0}'; give day, dusk or night")]
pub struct UnknownVariant(pub String);

/// Multiplies every colour that the splats show, from every side: colour is `0.5 + C sh_0 + ...`, so
/// the constant takes up the offset and the others scale.
fn light(splats: &mut Splats, gain: [f32; 3]) {
    let per_splat = splats.sh_coefficients() * 3;
    for colour in splats.sh.chunks_exact_mut(per_splat) {
        for (n, value) in colour.iter_mut().enumerate() {
            let gain = gain[n % 3];
            let offset = if n < 3 { 0.5 * (gain - 1.0) / SH_CONSTANT } else { 0.0 };
            *value = *value * gain + offset;
        }
    }
}

/// The constant harmonic, 1 / (2 sqrt(pi)).
const SH_CONSTANT: f32 = 0.282_094_8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_multiplies_what_is_shown() {
        let mut splats = Splats {
            means_m: vec![glam::Vec3::ZERO],
            scales_m: vec![glam::Vec3::ONE],
            rotations: vec![glam::Quat::IDENTITY],
            opacities: vec![0.9],
            sh_degree: 1,
            sh: (0..12).map(|n| 0.1 * n as f32).collect(),
        };
        let before = splats.sh.clone();
        light(&mut splats, [0.5, 0.25, 1.0]);
        for channel in 0..3 {
            // Seen along a direction in which the three linear harmonics are 0.2, -0.3 and 0.1.
            let shown = |sh: &[f32]| {
                0.5 + SH_CONSTANT * sh[channel] + 0.2 * sh[3 + channel] - 0.3 * sh[6 + channel]
                    + 0.1 * sh[9 + channel]
            };
            let expected = shown(&before) * [0.5, 0.25, 1.0][channel];
            assert!((shown(&splats.sh) - expected).abs() < 1e-5, "channel {channel}");
        }
    }

    #[test]
    fn names_parse_and_print() {
        for variant in Variant::ALL {
            assert_eq!(variant.to_string().parse(), Ok(variant));
        }
        assert!("noon".parse::<Variant>().unwrap_err().to_string().contains("'noon'"));
    }
}
