//! The progress of a load, reported from any thread.

use std::sync::{Mutex, PoisonError};

/// How far a load has come. Its unit is splats times passes over them (a packed file is inflated,
/// then decoded), so only the ratio means something; it never falls, and ends at `total`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Work done, at most `total`.
    pub done: u64,
    /// All the work there is; at least 1.
    pub total: u64,
}

/// What a load calls as it comes along: some hundred times for a million splats, from its worker
/// threads, one call at a time.
pub type Report<'a> = &'a mut (dyn FnMut(Progress) + Send);

/// Adds up the work of all threads of a load.
pub(super) struct Meter<'a>(Option<Mutex<State<'a>>>);

struct State<'a> {
    at: Progress,
    report: Report<'a>,
}

impl<'a> Meter<'a> {
    /// Tells nobody.
    pub(super) const SILENT: Meter<'static> = Meter(None);

    pub(super) fn new(report: Report<'a>) -> Self {
        Self(Some(Mutex::new(State { at: Progress { done: 0, total: 1 }, report })))
    }

    /// Reports how much work there is, once it is known.
    pub(super) fn expect(&self, total: usize) {
        self.update(|at| at.total = (total as u64).max(1));
    }

    /// Adds work done.
    pub(super) fn add(&self, work: usize) {
        self.update(|at| at.done = (at.done + work as u64).min(at.total));
    }

    /// All is done, whatever was counted.
    pub(super) fn finish(&self) {
        self.update(|at| at.done = at.total);
    }

    fn update(&self, change: impl FnOnce(&mut Progress)) {
        if let Some(state) = &self.0 {
            // A report that panicked has ended this load anyhow.
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
