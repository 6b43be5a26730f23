//! Closed loop: the plugin flies generated courses by images of the twin, and the true geometry judges.

mod world;

fn check(project: &str, seed: u64) {
    let outcome = world::fly(project, seed, 90.0, |_, _, _, _| {});
    assert!(outcome.is_good(), "{project}, seed {seed}: {outcome:?}");
    assert!(outcome.drift_m < 0.3, "{project}, seed {seed}: {outcome:?}");
}

#[test]
fn windows_gap_and_hand_are_flown_through() {
    check("p5", 3);
}

#[test]
fn three_windows_are_flown_through() {
    check("p3", 5);
}

#[test]
fn a_gap_alone_is_flown_through() {
    check("p4", 2);
}
