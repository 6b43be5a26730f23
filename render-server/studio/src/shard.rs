//! Shard of a long job: `--shard 1/4` of flights or images, to distribute it over several computers.

use serde::{Deserialize, Serialize};

/// Maximum number of shards: the maximum number of seeds of a grade.
const MOST: u64 = 100_000;

/// One of several equal shares of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shard {
    /// From 1.
    pub index: u64,
    /// Total number of shards.
    pub count: u64,
}

impl Shard {
    /// Whether index and count are valid.
    pub fn is_one(index: u64, count: u64) -> bool {
        1 <= index && index <= count && count <= MOST
    }

    /// Whether the item with this index (from 0) belongs to the shard.
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
        parts.ok_or_else(|| format!("{text:?} is not a shard; give 1/4 to 4/4 for four shards"))
    }
}
