//! Plugin faults: they never reach the vehicle, and one message gives the reason.

use vizflyt_protocol::messages::{EventKind, FlightPhase, OutcomeKind};
use vizflyt_protocol::time::HostTime;

use super::plugin::Deed;
use super::rig::{Place, Plan, Rig};
use super::runtime::Settings;

/// A plugin fault and the expected reaction.
pub(crate) struct Case {
    deeds: &'static [Deed],
    /// Number of restarts of the plugin.
    restarts: u32,
    /// Time limit in the air; 0 uses the arena's. [s]
    time_limit_s: f64,
    /// Maximum time from the fault until the vehicle stops, or only descends. [s]
    holds_within_s: f64,
    /// Maximum time from the fault until landing begins; `None` if it only holds. [s]
    lands_within_s: Option<f64>,
    outcome: OutcomeKind,
    /// Message for the student.
    sentence: &'static str,
}

/// The plugin has ended: the runtime brakes and lands at once.
const AT_ONCE_S: (f64, Option<f64>) = (1.0, Some(1.5));
/// The plugin sends nothing: brakes after 0.5 s (as slowly as ArduCopter's defaults), lands after 2 s.
const SILENT_S: (f64, Option<f64>) = (1.3, Some(2.1));
/// Side of the fence in the direction of flight. [m, world]
pub(crate) const FENCE_X_M: f64 = 2.6;

const fn case(
    deeds: &'static [Deed],
    (holds_within_s, lands_within_s): (f64, Option<f64>),
    sentence: &'static str,
) -> Case {
    let outcome = OutcomeKind::PluginFailed;
    let (restarts, time_limit_s) = (0, 0.0);
    Case { deeds, restarts, time_limit_s, holds_within_s, lands_within_s, outcome, sentence }
}

pub(crate) const CASES: [Case; 14] = [
    case(&[Deed::Panic], AT_ONCE_S, "the plugin failed: panicked at"),
    case(&[Deed::Spin], SILENT_S, "the plugin has not answered image"),
    case(&[Deed::Sleep], SILENT_S, "the plugin has not answered image"),
    // Flies until the memory is full.
    case(&[Deed::Leak], (3.0, Some(3.5)), "more than its 200 MB of memory"),
    case(&[Deed::Fork], AT_ONCE_S, "more than its 40 processes and threads"),
    case(&[Deed::Exit], AT_ONCE_S, "the plugin ended by itself (exit status 0)"),
    case(&[Deed::Segfault], AT_ONCE_S, "SIGSEGV: it touched memory that is not its own"),
    case(&[Deed::Nan], SILENT_S, "a number in it is not finite"),
    case(&[Deed::Infinite], SILENT_S, "a number in it is not finite"),
    Case {
        outcome: OutcomeKind::Landed,
        time_limit_s: 7.0,
        // From the start to the fence at 3 m/s at most, and braking.
        ..case(&[Deed::Outside], (4.0, None), "asks to leave the geofence; the vehicle stops")
    },
    case(&[Deed::Flood], AT_ONCE_S, "more than 400 setpoints a second"),
    case(&[Deed::Types], AT_ONCE_S, "it sends an invalid message"),
    case(&[Deed::Print], SILENT_S, "the plugin has not answered image"),
    Case {
        outcome: OutcomeKind::Landed,
        restarts: 2,
        ..case(
            &[Deed::Segfault, Deed::Panic, Deed::Land],
            (1.0, None),
            "SIGSEGV: it touched memory that is not its own; the plugin is started again",
        )
    },
];

/// Flies a case; returns the flight's hash, and the violated requirement, if any.
pub(crate) fn fly(place: &Place, case: &Case) -> (u64, Option<String>) {
    let Case { deeds, restarts, time_limit_s, .. } = *case;
    let settings = Settings { deeds, restarts, time_limit_s };
    let (params, radio, bridge) = (Vec::new(), false, false);
    let seed = case.sentence.len() as u64;
    let mut rig = Rig::new(&Plan { place, params, radio, bridge, seed, settings });
    let what = format!("{deeds:?}");
    rig.until(&what, 90.0, |rig| rig.runtime().outcome().is_some());
    (rig.hash(), case.complaint(&rig).map(|why| format!("{what}: {why}{}", rig.story())))
}

impl Case {
    fn complaint(&self, rig: &Rig) -> Option<String> {
        let runtime = rig.runtime();
        let Some(deed) = runtime.plugin.deed_at else {
            return Some("it was not done".to_owned());
        };
        let track = &rig.seen.track;
        let deed_s = Rig::at_s(deed);
        let p_m = |at_s: f64| track.iter().find(|sight| sight.at_s >= at_s).map(|s| s.p_m);
        let moved_m = |at_s: f64| {
            let (Some(a), Some(b)) = (p_m(at_s), p_m(at_s + 0.2)) else { return 0.0 };
            (b - a).truncate().length()
        };
        let steps = (0..200).map(|n| 0.05 * f64::from(n));
        let stopped_s = steps.into_iter().find(|s| moved_m(deed_s + s) < 0.15 * 0.2);
        if !stopped_s.is_some_and(|s| s <= self.holds_within_s) {
            return Some(format!("it stood still after {stopped_s:?} s"));
        }
        let is_landing = |at: &HostTime, kind: &EventKind| {
            *at >= deed && matches!(kind, EventKind::Phase(FlightPhase::Landing))
        };
        let landing = runtime.events.iter().find(|(at, event)| is_landing(at, &event.kind));
        let landing_s = landing.map(|(at, _)| at.seconds_since(deed));
        if let Some(within_s) = self.lands_within_s
            && !landing_s.is_some_and(|s| s <= within_s)
        {
            return Some(format!("it landed after {landing_s:?} s"));
        }
        let end = rig.sight();
        let before_m = p_m(end.at_s - 0.4).expect("the flight took longer");
        let v_mps = (end.p_m - before_m).length() / 0.4;
        if !(end.p_m.z < 0.3 && v_mps < 0.2 && !rig.is_armed()) {
            return Some(format!("it ended {} m high, at {v_mps} m/s", end.p_m.z));
        }
        if runtime.outcome() != Some(self.outcome) {
            return Some(format!("it ended as {:?}", runtime.outcome()));
        }
        let said =
            |text: &str| runtime.events.iter().filter(|(_, e)| e.text.contains(text)).count();
        // A few messages, not a hundred.
        let count = said(self.sentence);
        if !(1..=12).contains(&count) {
            return Some(format!("'{}' was reported {count} times", self.sentence));
        }
        if runtime.restarts != self.restarts {
            return Some(format!("it was started again {} times", runtime.restarts));
        }
        let furthest_m = track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
        (furthest_m >= FENCE_X_M)
            .then(|| format!("it was at x = {furthest_m} m, outside the fence"))
    }
}
