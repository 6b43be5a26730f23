use glam::DVec3;
use proptest::prelude::*;
use vizflyt_arena::pose::PoseQuality;
use vizflyt_protocol::geometry::{Pose, Volume};
use vizflyt_protocol::messages::{
    ArenaInfo, ClockState, Guarded, Limits, PoseSample, VehicleState,
};
use vizflyt_protocol::time::ServerTime;

use super::checks::{self, Traffic};
use super::pose_window::PoseWindow;
use super::*;

fn arena() -> ArenaInfo {
    ArenaInfo::new(
        "test",
        Volume::aabb(DVec3::ZERO, DVec3::new(8.0, 4.0, 3.0)),
        Limits::new(2.0, 4.0),
    )
}

fn ok() -> Finding {
    Finding::of("fine".to_owned(), &[])
}

fn bad() -> Finding {
    Finding::of("worn".to_owned(), &["mend it".to_owned()])
}

#[test]
fn checks_have_the_order_of_their_ids() {
    for (at, check) in CHECKS.iter().enumerate() {
        assert_eq!(check.id as usize, at);
        assert_eq!(check.id.info().title, check.title);
    }
}

/// Evaluates poses at a rate, at rest except for noise, with one gap, `later_s` after the last pose.
fn localized(rate_hz: f64, noise_mm: f64, gap_s: f64, later_s: f64) -> Option<Finding> {
    let mut window = PoseWindow::default();
    let mut at_s = 100.0;
    for n in 0..(2.5 * rate_hz) as u32 {
        at_s += 1.0 / rate_hz + if n == 20 { gap_s } else { 0.0 };
        let x_m = if n % 2 == 0 { noise_mm * 1e-3 } else { -noise_mm * 1e-3 };
        let stamp = ServerTime::ZERO.plus_seconds(at_s);
        window.push(&PoseSample::still(stamp, Pose::new(DVec3::X * x_m, glam::DQuat::IDENTITY)));
    }
    checks::localization(at_s + later_s, &window, &quality(rate_hz), &arena())
}

fn quality(rate_hz: f64) -> PoseQuality {
    PoseQuality { rate_hz, position_sigma_mm: 1.0, ..PoseQuality::default() }
}

#[test]
fn evaluates_localization_by_gaps_jitter_and_silence() {
    let good = localized(200.0, 0.5, 0.0, 0.005).unwrap();
    assert!(good.ok, "{good:?}");
    assert_eq!(good.evidence, "200 Hz, longest gap 5 ms, sigma 1.0 mm, 0.5 mm rms at rest");
    let gap = localized(200.0, 0.5, 0.2, 0.005).unwrap();
    assert!(!gap.ok && gap.todo.contains("205 ms holds the vehicle"), "{gap:?}");
    let trembles = localized(200.0, 15.0, 0.0, 0.005).unwrap();
    assert!(!trembles.ok && trembles.todo.contains("trembles"), "{trembles:?}");
    let moves = localized(200.0, 80.0, 0.0, 0.005).unwrap();
    assert!(moves.ok && moves.evidence.contains("no jitter"), "{moves:?}");
    let unsure = PoseQuality { position_sigma_mm: 80.0, ..quality(200.0) };
    let mut window = PoseWindow::default();
    for n in 0..200 {
        let stamp = ServerTime::ZERO.plus_seconds(f64::from(n) * 0.01);
        window.push(&PoseSample::still(stamp, Pose::new(DVec3::ZERO, glam::DQuat::IDENTITY)));
    }
    let unsure = checks::localization(2.0, &window, &unsure, &arena()).unwrap();
    assert!(!unsure.ok && unsure.todo.contains("three sigmas"), "{unsure:?}");
    let silent = localized(200.0, 0.5, 0.0, 4.0).unwrap();
    assert!(!silent.ok && silent.evidence == "no pose for 4.0 s", "{silent:?}");
    let mut window = PoseWindow::default();
    assert_eq!(
        checks::localization(5.0, &window, &quality(0.0), &arena()),
        None,
        "never a pose: nothing to say"
    );
    window.push(&PoseSample::still(
        ServerTime::ZERO.plus_seconds(5.0),
        Pose::new(DVec3::ZERO, glam::DQuat::IDENTITY),
    ));
    assert_eq!(checks::localization(5.1, &window, &quality(0.0), &arena()), None);
}

#[test]
fn evaluates_the_network_between_two_times() {
    let before = Traffic { at_s: 10.0, rtt_ms: 9.0, sent: 1000, lost: 50, bytes: 1_000_000 };
    let then = |rtt_ms, sent, lost| Traffic { at_s: 15.0, rtt_ms, sent, lost, bytes: 6_000_000 };
    let good = checks::network(&before, &then(1.2, 3000, 52)).unwrap();
    assert_eq!(good.evidence, "round trip 1.2 ms, 0.10 % of 2000 packets lost, 8.0 Mbit/s in 5 s");
    assert!(good.ok);
    assert!(!checks::network(&before, &then(1.2, 3000, 100)).unwrap().ok, "2.5 % lost");
    assert!(!checks::network(&before, &then(25.0, 3000, 50)).unwrap().ok, "slow");
    assert_eq!(checks::network(&before, &then(1.0, 1050, 50)), None, "too few to tell");
    assert_eq!(checks::network(&before, &then(1.0, 10, 0)), None, "another connection");
}

#[test]
fn evaluates_clocks_images_and_battery() {
    let clock =
        ClockState { offset_ns: 1_500_000_000, error_bound_ms: 0.4, ..ClockState::default() };
    assert!(checks::clocks(&clock).ok);
    assert!(!checks::clocks(&ClockState { error_bound_ms: 6.0, ..clock }).ok);
    assert!(!checks::clocks(&ClockState { error_bound_ms: f32::NAN, ..clock }).ok);
    assert!(checks::latency(40.0, 80.0, 300, 5.0).unwrap().ok);
    assert!(!checks::latency(40.0, 180.0, 300, 5.0).unwrap().ok);
    assert_eq!(checks::latency(0.0, 0.0, 0, 5.0), None);
    let state = |battery_v, battery_fraction| VehicleState {
        battery_v,
        battery_fraction,
        ..VehicleState::default()
    };
    assert_eq!(checks::battery(&state(16.4, 0.9)).evidence, "16.40 V, 90 % left");
    let low = checks::battery(&state(14.2, 0.3));
    assert!(!low.ok && low.todo.contains("full pack"), "{low:?}");
    assert!(!checks::battery(&state(0.0, -1.0)).ok);
    assert!(checks::battery(&state(16.0, -1.0)).ok);
}

#[test]
fn compares_the_fence_in_three_places() {
    let arena = arena();
    let guard = Guarded::of(&arena, Some(1));
    let parameter =
        |has| vec![FenceParameter { name: "FENCE_ALT_MAX".to_owned(), has, right: 2.9 }];
    let good = checks::fence(&arena, &guard, Some(&parameter(Some(2.9))));
    assert!(good.ok, "{good:?}");
    assert!(
        good.evidence.contains("autopilot: 1 polygons accepted, FENCE_ALT_MAX 2.90"),
        "{good:?}"
    );
    let check = |guard: &Guarded, parameters: Option<&[FenceParameter]>, expected: &str| {
        let found = checks::fence(&arena, guard, parameters);
        assert!(!found.ok && found.todo.contains(expected), "{found:?}");
    };
    check(&guard, None, "are not known");
    check(&guard, Some(&parameter(Some(30.0))), "FENCE_ALT_MAX must be 2.90");
    check(&guard, Some(&parameter(None)), "FENCE_ALT_MAX must be 2.90");
    check(&Guarded { polygons: None, ..guard }, Some(&[]), "not accepted the net");
    let wider = Volume::aabb(DVec3::ZERO, DVec3::splat(9.0));
    check(&Guarded { geofence: wider, ..guard }, Some(&[]), "another fence");
    check(&Guarded { limits: Limits::new(5.0, 4.0), ..guard }, Some(&[]), "allows more");
    let slower = Guarded { limits: Limits::new(1.0, 4.0), ..guard };
    assert!(checks::fence(&arena, &slower, Some(&[])).ok, "the vehicle's own limits are stricter");
}

#[test]
fn evidence_expires_and_changes_are_logged_once() {
    let mut day = LabDay::new(0);
    assert_eq!(day.state("wasp", CheckId::Battery, 1000), State::NotDone);
    for at in [1000, 2000, 3000] {
        day.record("wasp", CheckId::Battery, ok(), "the server", at);
    }
    assert_eq!(day.story().count(), 1, "live evidence that stays the same is one line");
    day.record("wasp", CheckId::Battery, bad(), "the server", 4000);
    assert_eq!(day.state("wasp", CheckId::Battery, 5000), State::Failed);
    assert_eq!(day.state("bee", CheckId::Battery, 5000), State::NotDone);
    assert_eq!(day.state("wasp", CheckId::Battery, 70_000), State::Outdated);
    let last = day.story().last().unwrap();
    assert_eq!(last.text, "wasp: battery failed: worn (mend it), by the server");
    day.record("", CheckId::Net, ok(), "Ada", 5000);
    assert_eq!(day.state("", CheckId::Net, 3_600_000), State::Ok);
    assert_eq!(day.state("", CheckId::Net, 13 * 3_600_000), State::Outdated);
    day.unsign("", CheckId::Net, "Ada", 6000);
    assert_eq!(day.state("", CheckId::Net, 7000), State::NotDone);
    assert_eq!(day.story().last().unwrap().text, "net closed taken back by Ada");
}

#[test]
fn the_autopilots_fence_expires_with_its_evidence() {
    let mut day = LabDay::new(0);
    let fence =
        vec![FenceParameter { name: "FENCE_ENABLE".to_owned(), has: Some(1.0), right: 1.0 }];
    day.bring_fence("wasp", fence.clone());
    assert_eq!(day.fence("wasp", 0), None, "without evidence of its parameters");
    day.record("wasp", CheckId::Parameters, ok(), "vizflyt doctor", 0);
    assert_eq!(day.fence("wasp", 1000), Some(&fence[..]));
    assert_eq!(day.fence("wasp", 13 * 3_600_000), None);
}

fn full_day() -> LabDay {
    let mut day = LabDay::new(1);
    day.record("wasp", CheckId::Stop, bad(), "the page", 2);
    day.record("", CheckId::Net, ok(), "Ada", 3);
    day.bring_fence(
        "wasp",
        vec![FenceParameter { name: "FENCE_ENABLE".to_owned(), has: None, right: 1.0 }],
    );
    day.queue.book("ants", "wasp", 4).unwrap();
    day.queue.book("bees", "wasp", 4).unwrap();
    day.queue.call_next("wasp", 5).unwrap();
    day.order =
        TakeOffOrder { vehicles: vec!["wasp".to_owned(), "bee".to_owned()], until: Until::Landed };
    day.set_separation(Some(1.5)).unwrap();
    day
}

#[test]
fn rejects_a_separation_out_of_range() {
    let mut day = LabDay::new(0);
    for wrong in [0.0, -1.0, 0.1, 21.0, f64::NAN, f64::INFINITY] {
        assert!(day.set_separation(Some(wrong)).is_err(), "{wrong}");
    }
    assert_eq!(day.separation_m, None);
    assert!(day.set_separation(None).is_ok());
}

#[test]
fn a_stored_day_is_read_back() {
    let day = full_day();
    assert_eq!(LabDay::parse(&day.to_bytes()).unwrap(), day);
    let text = String::from_utf8(day.to_bytes()).unwrap();
    for (was, is, expected) in [
        ("\"version\": 1", "\"version\": 2", "version 2"),
        ("\"separation_m\": 1.5", "\"separation_m\": 1e9", "separation"),
        ("\"next_id\": 2", "\"next_id\": 1", "queue"),
        ("\"story\"", "\"tale\"", "tale"),
    ] {
        assert!(text.contains(was), "{text}");
        let error = LabDay::parse(text.replace(was, is).as_bytes()).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

proptest! {
    /// A file truncated anywhere, or with any byte changed, is rejected or is a consistent day; the parser does
    /// not panic.
    #[test]
    fn a_damaged_file_is_rejected_or_consistent(cut in 0..4000_usize, at in 0..4000_usize, byte in any::<u8>()) {
        let mut bytes = full_day().to_bytes();
        let at = at % bytes.len();
        bytes[at] = byte;
        bytes.truncate(bytes.len() - cut.min(bytes.len() - 1) * usize::from(byte % 2 == 0));
        if let Ok(day) = LabDay::parse(&bytes) {
            prop_assert!(day.queue.is_sound());
            prop_assert_eq!(LabDay::parse(&day.to_bytes()).ok(), Some(day));
        }
    }

    #[test]
    fn rejects_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        prop_assert!(LabDay::parse(&bytes).is_err());
    }
}
