//! The check of axes on the page: somebody moves the vehicle as asked, and the server watches its poses.

use vizflyt_protocol::messages::PoseSample;

use crate::flights::lab_day::Finding;
use crate::poses::hand_check::{Check, Diagnosis, HandCheckStep};
use crate::poses::settings::LocalizationConfig;

/// A check under way.
#[derive(Debug)]
pub(in crate::web) struct Guided {
    /// The vehicle, by its index.
    pub(in crate::web) vehicle: usize,
    check: Check,
    newest_s: f64,
    /// Who began it.
    pub(in crate::web) by: String,
}

impl Guided {
    /// Begins; poses will come as `source` makes them.
    pub(in crate::web) fn new(vehicle: usize, source: LocalizationConfig, by: String) -> Self {
        Self { vehicle, check: Check::new(source), newest_s: f64::NEG_INFINITY, by }
    }

    /// Returns what is to be done, and what was seen last.
    pub(in crate::web) fn ask(&self) -> (String, String) {
        (self.check.step().ask().to_owned(), self.check.seen())
    }

    /// Takes the vehicle's pose; returns the result once all was seen.
    pub(in crate::web) fn handle_pose(&mut self, pose: &PoseSample) -> Option<Finding> {
        let at_s = pose.stamp.as_ns() as f64 * 1e-9;
        if at_s <= self.newest_s {
            return None;
        }
        self.newest_s = at_s;
        self.check.handle_pose(at_s, &pose.world_from_body);
        (self.check.step() == HandCheckStep::Done).then(|| finding(self.check.diagnosis()))
    }
}

fn finding(diagnosis: Diagnosis) -> Finding {
    let Diagnosis { faults, change, others } = diagnosis;
    if faults.is_empty() {
        let evidence =
            "lifted, pushed, turned and raised by hand: axes, units and turns are as they must be";
        return Finding::of(evidence.to_owned(), &[]);
    }
    let set = |change: &[(&str, String)]| {
        change.iter().map(|(key, value)| format!("{key} = {value}")).collect::<Vec<_>>().join(", ")
    };
    let todo = if change.is_empty() {
        "no setting explains all of it: do it again, one motion at a time; then vizflyt doctor localization".to_owned()
    } else {
        let all: Vec<_> =
            std::iter::once(&change).chain(&others).map(|change| set(change)).collect();
        format!("set {} in [[localization]], then start the server again", all.join(", or "))
    };
    Finding { ok: false, evidence: faults.join("; "), todo }
}
