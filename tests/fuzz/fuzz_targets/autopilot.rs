//! MAVLink input of the simulated autopilot: any bytes on any of its links, over a cable or Wi-Fi, with time steps and
//! failures.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, MavlinkVersion, Message, encode};
use vizflyt_simulator::autopilot::Radio;
use vizflyt_simulator::simulation::{MAX_LINKS, Simulation, SimulationConfig};
use vizflyt_simulator::wifi::WifiConfig;

/// The mission protocol: MISSION_COUNT, ITEM_INT, ACK, REQUEST_INT, REQUEST_LIST, CLEAR_ALL.
const MISSION: [u32; 6] = [44, 73, 47, 51, 43, 45];

/// Sends a complete message of the mission protocol with this payload.
fn inject(simulation: &mut Simulation, which: u8, payload: &[u8]) {
    let id = MISSION[usize::from(which) % MISSION.len()];
    let Ok(message) = MavMessage::parse(MavlinkVersion::V2, id, payload) else { return };
    let header = MavHeader { system_id: 255, component_id: 191, sequence: which };
    simulation.handle_mavlink(0, encode(header, &message, &mut [0; MAX_PACKET]));
}

fuzz_target!(|input: (bool, bool, Vec<(u8, &[u8])>)| {
    let (over_wifi, radio, steps) = input;
    let config = SimulationConfig {
        wifi: over_wifi.then(WifiConfig::default),
        radio,
        vibration_mps2: 100.0,
        gust_mps: 1.0,
        ..SimulationConfig::default()
    };
    let mut simulation = Simulation::new(config).unwrap();
    let mut buffer = [0; MAX_PACKET];
    for (what, packet) in steps {
        match what {
            250 => simulation.reboot(),
            251 => simulation.set_radio(Radio::Lost),
            252 => simulation.set_radio(Radio::Receiving),
            253 => simulation.break_motor(packet.len() % 4, 0.5),
            240..=249 => inject(&mut simulation, what - 240, packet),
            link => simulation.handle_mavlink(usize::from(link) % MAX_LINKS, packet),
        }
        for _ in 0..5 {
            simulation.tick();
        }
        while simulation.poll_mavlink(&mut buffer).is_some() {}
        let state = simulation.state();
        assert!(state.pose().is_valid());
    }
});
