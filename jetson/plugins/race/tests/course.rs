//! Closed loop: the plugin flies generated courses with rendered images, and the true geometry decides.

mod world;

fn check(project: &str, seed: u64) {
    let outcome = world::fly(project, seed, 90.0, |_, _, _, _| {});
    assert!(outcome.is_good(), "{project}, seed {seed}: {outcome:?}");
    assert!(outcome.drift_m < 0.3, "{project}, seed {seed}: {outcome:?}");
}

#[test]
fn flies_through_windows_gap_and_hand() {
    check("p5", 3);
}

#[test]
fn flies_through_three_windows() {
    check("p3", 5);
}

#[test]
fn flies_through_a_single_gap() {
    check("p4", 2);
}
