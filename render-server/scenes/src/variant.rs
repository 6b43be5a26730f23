//! The same place in another light or in fog: what a plugin must cope with besides the seed.

use core::fmt;
use core::str::FromStr;

use vizflyt_arena::config::EnvironmentConfig;

/// One of the environments that have a name, [`EnvironmentConfig::NAMED`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Variant {
    name: &'static str,
    environment: EnvironmentConfig,
}

impl Variant {
    /// As captured.
    pub const DAY: Self =
        Self { name: EnvironmentConfig::NAMED[0].0, environment: EnvironmentConfig::NAMED[0].1 };

    /// Returns the names of all, as help and messages list them.
    pub fn names() -> String {
        EnvironmentConfig::NAMED.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
    }

    /// Returns the variant's name as the command line takes it.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Returns what it is.
    pub fn environment(&self) -> EnvironmentConfig {
        self.environment
    }
}

impl Default for Variant {
    fn default() -> Self {
        Self::DAY
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name)
    }
}

impl FromStr for Variant {
    type Err = UnknownVariant;

    fn from_str(text: &str) -> Result<Self, UnknownVariant> {
        EnvironmentConfig::NAMED
            .iter()
            .find(|(name, _)| *name == text)
            .map(|&(name, environment)| Self { name, environment })
            .ok_or_else(|| UnknownVariant(text.to_owned()))
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
}
