//! A lab day: what is checked before flights with its evidence, who flies when, and how several vehicles keep apart.
//!
//! ```text
//! in   what the server measures, what `vizflyt doctor` brings, what people sign; the page's orders; the time
//! out  the state of each check, the queue, why a vehicle may not start, whom to land; the file that keeps it all
//! ```
//! Pure: whoever measures and keeps it is `web/lab`.

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

/// A lab day, as it is kept in its file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabDay {
    version: u32,
    /// When it began. [ms since 1970]
    pub began_unix_ms: u64,
    records: Vec<Record>,
    /// Who flies when.
    pub queue: Queue,
    /// Who takes off after whom.
    pub order: TakeOffOrder,
    /// Least distance between the centres of two vehicles in the air; none is kept without one. [m]
    pub separation_m: Option<f64>,
    /// FENCE_* of each vehicle's autopilot, as brought by `vizflyt doctor vehicle`.
    fences: Vec<(String, Vec<FenceParameter>)>,
    story: VecDeque<Told>,
}

/// The newest evidence of a check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Which vehicle; empty is the room.
    pub vehicle: String,
    /// Which check.
    pub check: CheckId,
    /// What was found.
    pub finding: Finding,
    /// When. [ms since 1970]
    pub at_unix_ms: u64,
    /// By whom.
    pub by: String,
}

/// Something that happened, for the report.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Told {
    /// When. [ms since 1970]
    pub at_unix_ms: u64,
    /// In a sentence.
    pub text: String,
}

/// Where a check stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// There is no evidence.
    NotDone,
    /// It is as it must be.
    Ok,
    /// It is not.
    Failed,
    /// The evidence is too old.
    Outdated,
}

impl State {
    /// Returns it in words.
    pub fn words(self) -> &'static str {
        match self {
            Self::NotDone => "not done",
            Self::Ok => "ok",
            Self::Failed => "failed",
            Self::Outdated => "outdated",
        }
    }
}

/// Why a kept day cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BadDay {
    /// It is no day of ours.
    #[error("it is no lab day of this version: {0}")]
    Unreadable(#[from] serde_json::Error),
    /// Of another version.
    #[error("it is of version {0}, this program reads {VERSION}")]
    Version(u32),
    /// What it says cannot be.
    #[error("{0}")]
    Unsound(&'static str),
}

impl LabDay {
    /// Returns a day on which nothing was done yet.
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

    /// Reads a day that was kept.
    ///
    /// # Errors
    /// Bytes that are none.
    pub fn parse(bytes: &[u8]) -> Result<Self, BadDay> {
        let day: Self = serde_json::from_slice(bytes)?;
        if day.version != VERSION {
            return Err(BadDay::Version(day.version));
        }
        let is_finite = day.separation_m.is_none_or(|m| SEPARATION_M.contains(&m));
        if !is_finite {
            return Err(BadDay::Unsound("its separation is outside what can be set"));
        }
        if !day.queue.is_sound() {
            return Err(BadDay::Unsound("its queue cannot be"));
        }
        if day.records.len() > MAX_RECORDS
            || day.story.len() > MAX_STORY
            || day.fences.len() > MAX_RECORDS
        {
            return Err(BadDay::Unsound("it is longer than any day"));
        }
        Ok(day)
    }

    /// Returns it as bytes to keep.
    pub fn to_bytes(&self) -> Vec<u8> {
        // Why: it has string keys and finite numbers alone.
        serde_json::to_vec_pretty(self).unwrap_or_default()
    }

    /// Takes the evidence of a check; what changes is told. Returns whether something was.
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

    /// Takes a signature back.
    pub fn unsign(&mut self, vehicle: &str, check: CheckId, by: &str, now_unix_ms: u64) {
        self.records.retain(|r| !(r.vehicle == vehicle && r.check == check));
        let of = if vehicle.is_empty() { String::new() } else { format!("{vehicle}: ") };
        self.tell(format!("{of}{} taken back by {by}", check.info().title), now_unix_ms);
    }

    /// Returns the newest evidence of a check.
    pub fn evidence(&self, vehicle: &str, check: CheckId) -> Option<&Record> {
        self.records.iter().find(|r| r.vehicle == vehicle && r.check == check)
    }

    /// Returns where a check stands.
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

    /// Takes FENCE_* of a vehicle's autopilot.
    pub fn bring_fence(&mut self, vehicle: &str, fence: Vec<FenceParameter>) {
        self.fences.retain(|(name, _)| name != vehicle);
        if self.fences.len() < MAX_RECORDS {
            self.fences.push((vehicle.to_owned(), fence));
        }
    }

    /// Returns FENCE_* of a vehicle's autopilot, if they were brought and the evidence still counts.
    pub fn fence(&self, vehicle: &str, now_unix_ms: u64) -> Option<&[FenceParameter]> {
        let is_old = matches!(
            self.state(vehicle, CheckId::Parameters, now_unix_ms),
            State::NotDone | State::Outdated
        );
        let found = self.fences.iter().find(|(name, _)| name == vehicle && !is_old);
        found.map(|(_, fence)| fence.as_slice())
    }

    /// Sets the least distance between vehicles in the air; `None` is none. [m]
    ///
    /// # Errors
    /// A distance that cannot be kept.
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

    /// Notes something for the report.
    pub fn tell(&mut self, text: String, now_unix_ms: u64) {
        if self.story.len() >= MAX_STORY {
            self.story.pop_front();
        }
        self.story.push_back(Told { at_unix_ms: now_unix_ms, text });
    }

    /// Returns what happened, oldest first.
    pub fn story(&self) -> impl Iterator<Item = &Told> {
        self.story.iter()
    }
}

const VERSION: u32 = 1;
/// Checks of eight vehicles, and of some that were there before.
const MAX_RECORDS: usize = 400;
/// What is told of a day; of more the newest.
const MAX_STORY: usize = 1000;
