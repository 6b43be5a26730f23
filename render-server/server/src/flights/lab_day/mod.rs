//! Lab day: checks before flights with their evidence, the queue of teams, and the separation of vehicles.
//!
//! ```text
//! in   measurements of the server, reports of `vizflyt doctor`, signatures; commands of the page; the time
//! out  the state of each check, the queue, why a vehicle may not start, vehicles to land; the stored file
//! ```
//! Pure: `web/lab` measures and stores.

pub mod checks;
pub mod formation;
pub mod pose_window;
pub mod queue;
pub mod stop_trial;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

pub use self::checks::{CHECKS, CheckId, CheckInfo, FenceParameter, Finding, How};
pub use self::formation::{SEPARATION_M, Stand, TakeOffOrder, Until};
pub use self::queue::{Booking, BookingState, Queue};

/// Lab day, as stored in its file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabDay {
    version: u32,
    /// Start of the day. [ms since 1970]
    pub began_unix_ms: u64,
    records: Vec<Record>,
    /// Queue of teams.
    pub queue: Queue,
    /// Order of take-off.
    pub order: TakeOffOrder,
    /// Minimum distance between the centres of two vehicles in the air; not enforced if absent. [m]
    pub separation_m: Option<f64>,
    /// FENCE_* of each vehicle's autopilot, from `vizflyt doctor vehicle`.
    fences: Vec<(String, Vec<FenceParameter>)>,
    story: VecDeque<Told>,
}

/// Newest evidence of a check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Name of the vehicle; empty for the room.
    pub vehicle: String,
    pub check: CheckId,
    pub finding: Finding,
    /// Time of the evidence. [ms since 1970]
    pub at_unix_ms: u64,
    /// Who or what gave the evidence.
    pub by: String,
}

/// Log entry for the report.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Told {
    pub at_unix_ms: u64,
    /// Text of the entry.
    pub text: String,
}

/// State of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Without evidence.
    NotDone,
    /// Passed.
    Ok,
    /// Failed.
    Failed,
    /// The evidence is too old.
    Outdated,
}

impl State {
    /// Returns the state as text.
    pub fn words(self) -> &'static str {
        match self {
            Self::NotDone => "not done",
            Self::Ok => "ok",
            Self::Failed => "failed",
            Self::Outdated => "outdated",
        }
    }
}

/// Why a stored day cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BadDay {
    /// The file cannot be parsed.
    #[error("it is not a lab day of this version: {0}")]
    Unreadable(#[from] serde_json::Error),
    /// Unsupported version.
    #[error("it is of version {0}, this program reads {VERSION}")]
    Version(u32),
    /// Inconsistent contents.
    #[error("{0}")]
    Unsound(&'static str),
}

impl LabDay {
    /// Creates an empty day.
    pub fn new(now_unix_ms: u64) -> Self {
        Self {
            version: VERSION,
            began_unix_ms: now_unix_ms,
            records: Vec::new(),
            queue: Queue::default(),
            order: TakeOffOrder::default(),
            separation_m: None,
            fences: Vec::new(),
            story: VecDeque::new(),
        }
    }

    /// Parses a stored day.
    ///
    /// # Errors
    /// Invalid bytes.
    pub fn parse(bytes: &[u8]) -> Result<Self, BadDay> {
        let day: Self = serde_json::from_slice(bytes)?;
        if day.version != VERSION {
            return Err(BadDay::Version(day.version));
        }
        let is_finite = day.separation_m.is_none_or(|m| SEPARATION_M.contains(&m));
        if !is_finite {
            return Err(BadDay::Unsound("its separation is out of range"));
        }
        if !day.queue.is_sound() {
            return Err(BadDay::Unsound("its queue is inconsistent"));
        }
        if day.records.len() > MAX_RECORDS
            || day.story.len() > MAX_STORY
            || day.fences.len() > MAX_RECORDS
        {
            return Err(BadDay::Unsound("it has too many entries"));
        }
        Ok(day)
    }

    /// Returns the bytes of the file.
    pub fn to_bytes(&self) -> Vec<u8> {
        // It has only string keys and finite numbers.
        serde_json::to_vec_pretty(self).unwrap_or_default()
    }

    /// Records the evidence of a check, and logs changes. Returns whether an entry was logged.
    pub fn record(
        &mut self,
        vehicle: &str,
        check: CheckId,
        finding: Finding,
        by: &str,
        now_unix_ms: u64,
    ) -> bool {
        let before = self.state(vehicle, check, now_unix_ms);
        let state = if finding.ok { State::Ok } else { State::Failed };
        let is_told = check.info().how != How::Live || before != state;
        if is_told {
            let of = if vehicle.is_empty() { String::new() } else { format!("{vehicle}: ") };
            let todo = if finding.ok { String::new() } else { format!(" ({})", finding.todo) };
            let text = format!(
                "{of}{} {}: {}{todo}, by {by}",
                check.info().title,
                state.words(),
                finding.evidence
            );
            self.tell(text, now_unix_ms);
        }
        let (vehicle, by) = (vehicle.to_owned(), by.to_owned());
        let record = Record { vehicle, check, finding, at_unix_ms: now_unix_ms, by };
        self.records.retain(|r| !(r.vehicle == record.vehicle && r.check == check));
        if self.records.len() < MAX_RECORDS {
            self.records.push(record);
        }
        is_told
    }

    /// Removes a signature.
    pub fn unsign(&mut self, vehicle: &str, check: CheckId, by: &str, now_unix_ms: u64) {
        self.records.retain(|r| !(r.vehicle == vehicle && r.check == check));
        let of = if vehicle.is_empty() { String::new() } else { format!("{vehicle}: ") };
        self.tell(format!("{of}{} taken back by {by}", check.info().title), now_unix_ms);
    }

    /// Returns the newest evidence of a check.
    pub fn evidence(&self, vehicle: &str, check: CheckId) -> Option<&Record> {
        self.records.iter().find(|r| r.vehicle == vehicle && r.check == check)
    }

    /// Returns the state of a check.
    pub fn state(&self, vehicle: &str, check: CheckId, now_unix_ms: u64) -> State {
        let Some(record) = self.evidence(vehicle, check) else { return State::NotDone };
        let age_s = now_unix_ms.saturating_sub(record.at_unix_ms) as f64 * 1e-3;
        if age_s > check.valid_s() {
            State::Outdated
        } else if record.finding.ok {
            State::Ok
        } else {
            State::Failed
        }
    }

    /// Stores FENCE_* of a vehicle's autopilot.
    pub fn bring_fence(&mut self, vehicle: &str, fence: Vec<FenceParameter>) {
        self.fences.retain(|(name, _)| name != vehicle);
        if self.fences.len() < MAX_RECORDS {
            self.fences.push((vehicle.to_owned(), fence));
        }
    }

    /// Returns FENCE_* of a vehicle's autopilot, if stored and still valid.
    pub fn fence(&self, vehicle: &str, now_unix_ms: u64) -> Option<&[FenceParameter]> {
        let is_old = matches!(
            self.state(vehicle, CheckId::Parameters, now_unix_ms),
            State::NotDone | State::Outdated
        );
        let found = self.fences.iter().find(|(name, _)| name == vehicle && !is_old);
        found.map(|(_, fence)| fence.as_slice())
    }

    /// Sets the minimum distance between vehicles in the air; `None` disables it. [m]
    ///
    /// # Errors
    /// A distance out of range.
    pub fn set_separation(&mut self, least_m: Option<f64>) -> Result<(), String> {
        if let Some(least_m) = least_m.filter(|m| !SEPARATION_M.contains(m)) {
            let (from, to) = (SEPARATION_M.start(), SEPARATION_M.end());
            return Err(format!(
                "a separation of {least_m} m cannot be kept; give {from} to {to} m"
            ));
        }
        self.separation_m = least_m;
        Ok(())
    }

    /// Adds an entry to the log of the report.
    pub fn tell(&mut self, text: String, now_unix_ms: u64) {
        if self.story.len() >= MAX_STORY {
            self.story.pop_front();
        }
        self.story.push_back(Told { at_unix_ms: now_unix_ms, text });
    }

    /// Returns the log, oldest first.
    pub fn story(&self) -> impl Iterator<Item = &Told> {
        self.story.iter()
    }
}

const VERSION: u32 = 1;
/// Maximum records: for eight vehicles, and for some that were used before.
const MAX_RECORDS: usize = 400;
/// Maximum log entries; the oldest are dropped.
const MAX_STORY: usize = 1000;
