//! Cost of one simulated second: 400 ticks, with the vehicle hovering among 300 obstacles and vision at 50 Hz. A result
//! of 10 ms is 1 % of a core in real time.

use criterion::{Criterion, criterion_group, criterion_main};
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Pose, Volume};
use vizflyt_protocol::mavlink::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, encode, vision_to_mavlink};
use vizflyt_simulator::simulation::{Simulation, SimulationConfig, TICK_HZ};

fn send(lab: &mut Simulation, message: &MavMessage) {
    let header = MavHeader { system_id: 255, component_id: 1, sequence: 0 };
    lab.handle_mavlink(0, encode(header, message, &mut [0; MAX_PACKET]));
}

fn command(lab: &mut Simulation, command: MavCmd, param1: f32, param2: f32, param7: f32) {
    let data = COMMAND_LONG_DATA {
        param1,
        param2,
        param7,
        command,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    };
    send(lab, &MavMessage::COMMAND_LONG(data));
}

fn second(lab: &mut Simulation) {
    for tick in 0..TICK_HZ {
        lab.tick();
        if tick.is_multiple_of(8) {
            let state = lab.state();
            let pose = Pose::new(state.p_world_m, state.world_from_body);
            let usec = lab.now().as_ns() / 1000;
            let message = vision_to_mavlink(&pose, usec, 0, DVec3::splat(0.01), DVec3::splat(0.01));
            send(lab, &MavMessage::VISION_POSITION_ESTIMATE(message));
        }
        while lab.poll_mocap().is_some() {}
        while lab.poll_mavlink(&mut [0; MAX_PACKET]).is_some() {}
    }
}

// Why: SET_GPS_GLOBAL_ORIGIN is superseded in the dialect, but it is what ArduCopter accepts.
#[allow(deprecated)]
fn hovering() -> Simulation {
    let obstacles = (0..300)
        .map(|i| Volume::Cuboid {
            center_m: DVec3::new(f64::from(i % 20) - 10.0, f64::from(i / 20) - 7.0, 1.0),
            half_m: DVec3::splat(0.1),
            rotation: DQuat::IDENTITY,
        })
        .collect();
    let mut lab = Simulation::new(SimulationConfig { obstacles, ..Default::default() })
        .expect("no parameter is changed");
    (0..3).for_each(|_| second(&mut lab));
    let origin = vizflyt_protocol::mavlink::dialect::SET_GPS_GLOBAL_ORIGIN_DATA {
        target_system: 1,
        ..Default::default()
    };
    send(&mut lab, &MavMessage::SET_GPS_GLOBAL_ORIGIN(origin));
    (0..3).for_each(|_| second(&mut lab));
    command(&mut lab, MavCmd::MAV_CMD_DO_SET_MODE, 1.0, 4.0, 0.0);
    command(&mut lab, MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, 1.0, 0.0, 0.0);
    command(&mut lab, MavCmd::MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 1.5);
    (0..6).for_each(|_| second(&mut lab));
    assert!(lab.state().p_world_m.z > 1.0, "must be flying");
    lab
}

fn bench(criterion: &mut Criterion) {
    let mut lab = hovering();
    criterion.bench_function("one second of the lab", |b| b.iter(|| second(&mut lab)));
}

criterion_group!(benches, bench);
criterion_main!(benches);
