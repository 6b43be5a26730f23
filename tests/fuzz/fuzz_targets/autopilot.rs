//! The simulated autopilot's MAVLink side: any bytes, in order, with time going on.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_simulator::simulation::{Simulation, SimulationConfig};

fuzz_target!(|packets: Vec<&[u8]>| {
    let mut simulation = Simulation::new(SimulationConfig::default()).unwrap();
    let mut buffer = [0; MAX_PACKET];
    for packet in packets {
        simulation.handle_mavlink(0, packet);
        for _ in 0..5 {
            simulation.tick();
        }
        while simulation.poll_mavlink(&mut buffer).is_some() {}
        let state = simulation.state();
        assert!(state.pose().is_valid());
    }
});
