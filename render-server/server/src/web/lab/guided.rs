//! Check of axes on the page: a person moves the vehicle as instructed, and the server evaluates its poses.

use vizflyt_protocol::messages::PoseSample;

use crate::flights::lab_day::Finding;
use crate::poses::hand_check::{Check, Diagnosis, HandCheckStep};
use crate::poses::settings::LocalizationConfig;

/// A running check.
#[derive(Debug)]
pub(in crate::web) struct Guided {
    /// Index of the vehicle.
    pub(in crate::web) vehicle: usize,
    check: Check,
    newest_s: f64,
    /// Name of the person who started it.
    pub(in crate::web) by: String,
}

impl Guided {
    /// Begins a check for poses of `source`.
    pub(in crate::web) fn new(vehicle: usize, source: LocalizationConfig, by: String) -> Self {
        Self { vehicle, check: Check::new(source), newest_s: f64::NEG_INFINITY, by }
    }

    /// Returns the current instruction, and the last observation.
    pub(in crate::web) fn ask(&self) -> (String, String) {
        (self.check.step().ask().to_owned(), self.check.seen())
    }

    /// Processes a pose of the vehicle; returns the result when all steps are complete.
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
