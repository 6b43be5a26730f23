use std::f64::consts::TAU;

use super::*;

/// Returns a hand of 0.95 m that rotates about (0.1, 1.1) and is visible only above 1.2 m, and its true angle.
fn watch(omega_radps: f64, seconds: f64) -> (Hand, impl Fn(f64) -> f64) {
    let pivot_m = DVec2::new(0.1, 1.1);
    let angle_at = move |at_s: f64| 0.4 + omega_radps * at_s;
    let mut hand = Hand::default();
    for step in 0..(seconds * 20.0) as u32 {
        let at_s = f64::from(step) * 0.05;
        let along = DVec2::from_angle(angle_at(at_s));
        let points_m: Vec<DVec2> = (0..48)
            .flat_map(|n| [-0.03, 0.0, 0.03].map(|across| (f64::from(n) * 0.02, across)))
            .map(|(out, across)| pivot_m + along * out + along.perp() * across)
            .filter(|p_m| p_m.y > 1.2)
            .collect();
        hand.update(at_s, &points_m);
    }
    (hand, angle_at)
}

#[test]
fn estimates_pivot_speed_and_angle_in_one_and_a_half_turns() {
    for omega_radps in [TAU / 6.0, -TAU / 8.0] {
        let (hand, angle_at) = watch(omega_radps, 11.0);
        let motion = hand.motion().expect("it turns");
        assert!(motion.pivot_m.distance(DVec2::new(0.1, 1.1)) < 0.03, "{motion:?}");
        assert!((motion.omega_radps / omega_radps - 1.0).abs() < 0.03, "{motion:?}");
        let off_rad = wrap_pi(motion.angle_at(13.0) - angle_at(13.0));
        assert!(off_rad.abs() < 0.12, "{off_rad} rad off, seconds after the last sighting");
        assert!((motion.length_m - 0.95).abs() < 0.15, "{motion:?}");
    }
}

#[test]
fn way_is_clear_only_while_the_hand_is_away() {
    let (hand, angle_at) = watch(TAU / 6.0, 11.0);
    let above_m = DVec2::new(0.1, 1.7);
    let mut seen = [false; 2];
    for step in 0..120 {
        let at_s = 11.0 + f64::from(step) * 0.05;
        let apart_m = 0.6 * wrap_pi(angle_at(at_s) - TAU / 4.0).sin().abs();
        let away = wrap_pi(angle_at(at_s) - TAU / 4.0).abs() > 1.0;
        let clear = hand.is_clear(above_m, 0.2, at_s, at_s);
        assert!(!clear || away || apart_m > 0.2, "at {at_s} s");
        seen[usize::from(clear)] = true;
    }
    assert_eq!(seen, [true, true], "must be clear at some times and blocked at others");
    assert!(!hand.is_clear(above_m, 0.2, 11.0, 17.0), "must not be clear for a complete turn");
}

#[test]
fn way_is_not_clear_before_the_motion_is_known() {
    let (hand, _) = watch(TAU / 6.0, 0.5);
    assert_eq!(hand.motion(), None);
    assert!(!hand.is_clear(DVec2::new(0.1, 1.7), 0.2, 0.5, 1.0));
    // A window without a hand is clear after a long time without a sighting.
    let mut none = Hand::default();
    none.update(0.0, &[]);
    assert!(!none.is_clear(DVec2::ZERO, 0.2, 0.0, 1.0));
    none.update(NO_HAND_S + 1.0, &[]);
    assert!(none.is_clear(DVec2::ZERO, 0.2, 0.0, 1.0));
}

/// The hand is out of sight for more than half a turn; its speed determines the number of turns.
#[test]
fn counts_turns_while_out_of_sight() {
    for omega_radps in [TAU / 7.6, -TAU / 5.9] {
        let (mut hand, angle_at) = (Hand::default(), |at_s: f64| 0.3 + omega_radps * at_s);
        for step in 0..220 {
            let at_s = f64::from(step) * 0.05;
            let along = DVec2::from_angle(angle_at(at_s));
            let points_m: Vec<DVec2> = (0..48)
                .flat_map(|n| [-0.03, 0.0, 0.03].map(|across| (f64::from(n) * 0.02, across)))
                .map(|(out, across)| along * out + along.perp() * across)
                .filter(|p_m| p_m.y > 0.3)
                .collect();
            hand.update(at_s, &points_m);
        }
        let motion = hand.motion().expect("it turns");
        assert!((motion.omega_radps / omega_radps - 1.0).abs() < 0.03, "{motion:?}");
    }
}
