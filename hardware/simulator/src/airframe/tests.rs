use super::*;
use crate::motor::{THRUST_TO_WEIGHT, TIME_CONSTANT_S};
use proptest::prelude::*;
use vizflyt_protocol::geometry::yaw_of;

const DT_S: f64 = 1.0 / 800.0;

fn hover_speed() -> f64 {
    (1.0 / THRUST_TO_WEIGHT).sqrt()
}

fn fly(airframe: &mut Airframe, commands: [f64; 4], seconds: f64) {
    for _ in 0..(seconds / DT_S).round() as usize {
        airframe.tick(commands, DT_S);
    }
}

/// In the air at 10 m, with rotors at hover speed.
fn hovering() -> Airframe {
    let mut airframe = Airframe::standing(DVec3::ZERO, 0.0);
    airframe.state.p_world_m.z = 10.0;
    airframe.state.rotor_speed = [hover_speed(); 4];
    airframe
}

#[test]
fn stands_still_on_the_floor() {
    let start = DVec3::new(1.0, 2.0, 0.5);
    let mut airframe = Airframe::standing(start, 0.7);
    fly(&mut airframe, [0.0; 4], 5.0);
    let s = airframe.state();
    assert!((s.p_world_m - start).length() < 1e-6, "{:?}", s.p_world_m);
    assert!(s.v_world_mps.length() < 1e-6);
    assert!((yaw_of(s.world_from_body) - 0.7).abs() < 1e-9);
    assert!((airframe.specific_force_body_mps2() - DVec3::Z * GRAVITY_MPS2).length() < 1e-6);
    assert!(airframe.touches_floor());
}

#[test]
fn hovers_at_the_thrust_to_weight_fraction() {
    let mut airframe = hovering();
    fly(&mut airframe, [hover_speed(); 4], 2.0);
    assert!((airframe.state().p_world_m.z - 10.0).abs() < 1e-6);
    assert!(!airframe.touches_floor());
}

#[test]
fn full_throttle_from_hover_accelerates_by_the_excess_thrust() {
    let mut airframe = hovering();
    fly(&mut airframe, [1.0; 4], 0.2);
    // After 0.2 s = 5.7 time constants, the rotors are within 0.3 % of full speed.
    let a = airframe.specific_force_body_mps2().z;
    // Drag at the speed reached by then: 4-5 m/s.
    let drag = airframe.state().v_world_mps.z * 0.3;
    assert!((a - THRUST_TO_WEIGHT * GRAVITY_MPS2).abs() < 0.02 * a + drag, "{a}");
}

#[test]
fn rotors_lag_by_their_time_constant() {
    let mut airframe = hovering();
    airframe.state.rotor_speed = [0.0; 4];
    fly(&mut airframe, [1.0; 4], TIME_CONSTANT_S);
    let expected = 1.0 - (-1f64).exp();
    assert!((airframe.state().rotor_speed[0] - expected).abs() < 1e-3);
}

/// Checks the direction in which each pair of ArduCopter's motor order turns the vehicle.
#[test]
fn motors_turn_the_vehicle_like_ardupilots_quad_x() {
    let omega_after = |raised: [usize; 2]| {
        let mut airframe = hovering();
        let commands =
            std::array::from_fn(|i| hover_speed() + if raised.contains(&i) { 0.05 } else { -0.05 });
        fly(&mut airframe, commands, 0.05);
        airframe.state().omega_body_radps
    };
    // More thrust on the right (1 front right, 4 rear right): rolls left, which is -x in FLU.
    assert!(omega_after([0, 3]).x < -1.0);
    // More thrust at the rear (2 rear left, 4 rear right): nose down, which is +y in FLU.
    assert!(omega_after([1, 3]).y > 1.0);
    // Counter-clockwise propellers faster (1, 2): the frame turns clockwise, -z.
    assert!(omega_after([0, 1]).z < -0.1);
}

#[test]
fn a_fall_ends_on_the_floor_without_a_high_bounce() {
    let mut airframe = hovering();
    airframe.state.rotor_speed = [0.0; 4];
    let mut lowest = f64::INFINITY;
    let mut highest_after_touch = f64::NEG_INFINITY;
    for _ in 0..(6.0 / DT_S) as usize {
        airframe.tick([0.0; 4], DT_S);
        let z = airframe.state().p_world_m.z;
        lowest = lowest.min(z);
        if lowest < 0.01 {
            highest_after_touch = highest_after_touch.max(z);
        }
    }
    assert!(lowest >= -DEEPEST_M - 1e-9, "went through the floor: {lowest}");
    assert!(highest_after_touch < 0.1, "bounced to {highest_after_touch}");
    assert!(airframe.state().v_world_mps.length() < 1e-3);
}

/// Without air and thrust, only gravity acts: angular momentum is conserved. This checks the integrator and the
/// gyroscopic term together.
#[test]
fn free_tumbling_conserves_angular_momentum() {
    let mut airframe = hovering();
    airframe.state.p_world_m.z = 1000.0;
    airframe.state.rotor_speed = [0.0; 4];
    airframe.state.omega_body_radps = DVec3::new(6.0, 4.0, -3.0);
    let momentum = |a: &Airframe| {
        let s = a.state();
        s.world_from_body * (INERTIA_KGM2 * s.omega_body_radps)
    };
    let before = momentum(&airframe);
    fly(&mut airframe, [0.0; 4], 2.0);
    let after = momentum(&airframe);
    assert!((after - before).length() < 1e-6 * before.length(), "{before:?} {after:?}");
}

#[test]
fn drag_slows_a_glide_and_wind_carries_the_vehicle() {
    let mut airframe = hovering();
    airframe.state.v_world_mps = DVec3::new(5.0, 0.0, 0.0);
    fly(&mut airframe, [hover_speed(); 4], 1.0);
    let slowed = airframe.state().v_world_mps.x;
    assert!((3.0..4.5).contains(&slowed), "{slowed}");
    let mut airframe = hovering();
    airframe.set_wind(DVec3::new(0.0, 3.0, 0.0));
    fly(&mut airframe, [hover_speed(); 4], 1.0);
    assert!(airframe.state().v_world_mps.y > 0.3);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// For any motor commands, including NaN, the state stays finite and above the floor.
    #[test]
    fn any_command_keeps_the_state_finite(
        commands in prop::collection::vec(
            prop::array::uniform4(prop_oneof![
                8 => 0.0..1.0f64, 1 => Just(f64::NAN), 1 => Just(f64::INFINITY), 1 => Just(-5.0),
            ]), 1..30),
    ) {
        let mut airframe = Airframe::standing(DVec3::ZERO, 0.3);
        for command in commands {
            fly(&mut airframe, command, 0.1);
            let s = airframe.state();
            prop_assert!(s.p_world_m.is_finite() && s.v_world_mps.is_finite());
            prop_assert!(s.world_from_body.is_normalized() && s.omega_body_radps.is_finite());
            prop_assert!(s.p_world_m.z >= -DEEPEST_M - 1e-9);
            prop_assert!(airframe.specific_force_body_mps2().is_finite());
        }
    }
}
