//! Variants of a place with other light or weather, which a plugin must handle in addition to other seeds.

use core::fmt;
use core::str::FromStr;

use vizflyt_arena::config::EnvironmentConfig;

use crate::draw::DrawBounds;

/// Named environment of [`EnvironmentConfig::NAMED`], or a random one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variant {
    name: VariantName,
    environment: &'static EnvironmentConfig,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum VariantName {
    Known(&'static str),
    /// Number of the random environment, from 1.
    Drawn(u64),
}

impl Variant {
    /// Unchanged light and weather.
    pub const DAY: Self =
        Self::known(EnvironmentConfig::NAMED[0].0, &EnvironmentConfig::NAMED[0].1);

    const fn known(name: &'static str, environment: &'static EnvironmentConfig) -> Self {
        Self { name: VariantName::Known(name), environment }
    }

    /// Returns random variant `number` (from 1) of a seed, within bounds.
    pub fn drawn(seed: u64, number: u64, bounds: &DrawBounds) -> Self {
        // Why: a command draws at most `MAX_DRAWN` variants and needs them until its end. The leak keeps a variant
        // small and `Copy`.
        let environment = Box::leak(Box::new(bounds.draw(seed, number)));
        Self { name: VariantName::Drawn(number), environment }
    }

    /// Whether the variant is random.
    pub fn is_drawn(&self) -> bool {
        matches!(self.name, VariantName::Drawn(_))
    }

    /// Returns the names of all named variants, for help and messages.
    pub fn names() -> String {
        EnvironmentConfig::NAMED.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
    }

    /// Returns light and weather.
    pub fn environment(&self) -> EnvironmentConfig {
        *self.environment
    }
}

impl Default for Variant {
    fn default() -> Self {
        Self::DAY
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.name {
            VariantName::Known(name) => f.pad(name),
            // Two digits, so that the names sort by number.
            VariantName::Drawn(number) => f.pad(&format!("random-{number:02}")),
        }
    }
}

impl FromStr for Variant {
    type Err = UnknownVariant;

    fn from_str(text: &str) -> Result<Self, UnknownVariant> {
        EnvironmentConfig::NAMED
            .iter()
            .find(|(name, _)| *name == text)
            .map(|(name, environment)| Self::known(name, environment))
            .ok_or_else(|| UnknownVariant(text.to_owned()))
    }
}

/// Entry of `--variants`: a name, or `random:20` for this number of random variants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum VariantChoice {
    /// Named variant.
    Named(Variant),
    /// Number of random variants; their seed is known later.
    Random(u64),
}

/// Maximum number of random variants: the document of a grade has space for these and all named ones.
pub const MAX_DRAWN: u64 = 40;

impl FromStr for VariantChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some(count) = text.strip_prefix("random:") else {
            return text
                .parse()
                .map(Self::Named)
                .map_err(|error: UnknownVariant| error.to_string());
        };
        let count = count.parse().ok().filter(|count| (1..=MAX_DRAWN).contains(count));
        let count =
            count.ok_or_else(|| format!("'{text}': give random:1 to random:{MAX_DRAWN}"))?;
        Ok(Self::Random(count))
    }
}

/// Unknown name of a [`Variant`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no variant is called '{0}'; there are {all}", all = Variant::names())]
pub struct UnknownVariant(pub String);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_and_print() {
        for &(name, environment) in EnvironmentConfig::NAMED {
            let variant: Variant = name.parse().unwrap();
            assert_eq!(
                (variant.to_string(), variant.environment()),
                (name.to_owned(), environment)
            );
        }
        let error = "noon".parse::<Variant>().unwrap_err().to_string();
        assert_eq!(error, format!("no variant is called 'noon'; there are {}", Variant::names()));
        assert!(Variant::names().starts_with("day, "));
    }

    #[test]
    fn parses_names_and_random_counts() {
        assert_eq!("night".parse(), Ok(VariantChoice::Named("night".parse().unwrap())));
        assert_eq!("random:20".parse(), Ok(VariantChoice::Random(20)));
        for wrong in ["random:0", "random:41", "random:", "random:x", "random", "noon"] {
            assert!(wrong.parse::<VariantChoice>().is_err(), "{wrong}");
        }
        let drawn = Variant::drawn(3, 7, &DrawBounds::default());
        assert_eq!((drawn.to_string().as_str(), drawn.is_drawn()), ("random-07", true));
        assert_ne!(drawn.environment(), Variant::drawn(3, 8, &DrawBounds::default()).environment());
    }
}
