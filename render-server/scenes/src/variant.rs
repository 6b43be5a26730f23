//! The same place in another light or weather: what a plugin must cope with besides the seed.

use core::fmt;
use core::str::FromStr;

use vizflyt_arena::config::EnvironmentConfig;

use crate::draw::DrawBounds;

/// One of the environments that have a name, [`EnvironmentConfig::NAMED`], or one that was drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variant {
    name: VariantName,
    environment: &'static EnvironmentConfig,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum VariantName {
    Known(&'static str),
    /// Its number among those that were drawn, from 1.
    Drawn(u64),
}

impl Variant {
    /// As captured.
    pub const DAY: Self =
        Self::known(EnvironmentConfig::NAMED[0].0, &EnvironmentConfig::NAMED[0].1);

    const fn known(name: &'static str, environment: &'static EnvironmentConfig) -> Self {
        Self { name: VariantName::Known(name), environment }
    }

    /// Returns the variant of a number, from 1, of those that are drawn from a seed within bounds.
    pub fn drawn(seed: u64, number: u64, bounds: &DrawBounds) -> Self {
        // Why: a command draws at most `MAX_DRAWN`, and needs them until it ends; so a variant is as small and as easily
        // copied as a name.
        let environment = Box::leak(Box::new(bounds.draw(seed, number)));
        Self { name: VariantName::Drawn(number), environment }
    }

    /// Whether it was drawn.
    pub fn is_drawn(&self) -> bool {
        matches!(self.name, VariantName::Drawn(_))
    }

    /// Returns the names of all, as help and messages list them.
    pub fn names() -> String {
        EnvironmentConfig::NAMED.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
    }

    /// Returns what it is.
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
            // Sorted as text, they are in order.
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

/// What `--variants` lists: variants by name, or `random:20`, as many that are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum VariantChoice {
    /// One that has a name.
    Named(Variant),
    /// So many, drawn from a seed that is known later.
    Random(u64),
}

/// Drawn at most: a grade's document has room for these and all that have a name.
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

/// A name that is no [`Variant`].
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
    fn lists_take_names_and_numbers_to_draw() {
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
