//! Progress of loading a scene, reported from any thread.

use std::sync::{Mutex, PoisonError};

/// Progress of loading a scene. The unit is splats times passes (a packed file is inflated, then
/// decoded), so only the ratio is meaningful. `done` never decreases, and ends at `total`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Completed work, at most `total`.
    pub done: u64,
    /// Total work, at least 1.
    pub total: u64,
}

/// Callback for progress. It is called some hundred times for a million splats, from worker
/// threads, one call at a time.
pub type Report<'a> = &'a mut (dyn FnMut(Progress) + Send);

/// Sums the work of all loading threads.
pub(super) struct Meter<'a>(Option<Mutex<State<'a>>>);

struct State<'a> {
    at: Progress,
    report: Report<'a>,
}

impl<'a> Meter<'a> {
    /// Meter without a callback.
    pub(super) const SILENT: Meter<'static> = Meter(None);

    pub(super) fn new(report: Report<'a>) -> Self {
        Self(Some(Mutex::new(State { at: Progress { done: 0, total: 1 }, report })))
    }

    /// Sets the total work, once it is known.
    pub(super) fn expect(&self, total: usize) {
        self.update(|at| at.total = (total as u64).max(1));
    }

    /// Adds completed work.
    pub(super) fn add(&self, work: usize) {
        self.update(|at| at.done = (at.done + work as u64).min(at.total));
    }

    /// Sets the progress to complete, whatever was counted.
    pub(super) fn finish(&self) {
        self.update(|at| at.done = at.total);
    }

    fn update(&self, change: impl FnOnce(&mut Progress)) {
        if let Some(state) = &self.0 {
            // If the callback panicked, this load ends anyway.
            let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
            let before = state.at;
            change(&mut state.at);
            if state.at != before {
                let at = state.at;
                (state.report)(at);
            }
        }
    }
}
