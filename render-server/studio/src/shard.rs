//! A part of a long piece of work: `--shard 1/4` of flights or images, so that several computers share it.

use serde::{Deserialize, Serialize};

/// As many parts as a grade has seeds, at most.
const MOST: u64 = 100_000;

/// A part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shard {
    /// From 1.
    pub index: u64,
    /// How many there are.
    pub count: u64,
}

impl Shard {
    /// Whether there is such a part.
    pub fn is_one(index: u64, count: u64) -> bool {
        1 <= index && index <= count && count <= MOST
    }

    /// Whether what is at this index of the order belongs to it.
    pub fn holds(self, index: usize) -> bool {
        index as u64 % self.count == self.index - 1
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(index, count)| {
            let (index, count) = (index.parse().ok()?, count.parse().ok()?);
            Self::is_one(index, count).then_some(Self { index, count })
        });
        parts.ok_or_else(|| format!("{text:?} is no part; give 1/4 to 4/4 for four parts"))
    }
}
