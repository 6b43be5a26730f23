//! After its start, the guardian allocates no memory: neither while it forwards packets, nor while it lands a vehicle.

use std::net::UdpSocket;

use glam::DVec3;
use vizflyt_fixtures::CountingAllocator;
use vizflyt_guardian::port::{Port, Wanted};
use vizflyt_guardian::watch::{Out, Watch};
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::mavlink::dialect::{
    HEARTBEAT_DATA, MavAutopilot, MavMessage, MavModeFlag, MavType,
};
use vizflyt_protocol::mavlink::{
    GuidedMotion, GuidedSetpoint, MAX_PACKET, MavHeader, encode, guided_to_mavlink,
};
use vizflyt_protocol::messages::{PoseSample, YawTarget};
use vizflyt_protocol::time::{HostTime, ServerTime};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Sends to the port, as the process does.
struct ToPort<'a> {
    port: &'a Port,
    lands: u32,
}

impl Out for ToPort<'_> {
    fn send(&mut self, packet: &[u8]) {
        self.port.send(packet);
        self.lands += u32::from(packet[7] == 76);
    }

    fn say(&mut self, _: &'static str) {}
}

fn packet(source: (u8, u8), message: &MavMessage, buffer: &mut [u8; MAX_PACKET]) -> usize {
    let header = MavHeader { system_id: source.0.into(), component_id: source.1, sequence: 0 };
    encode(header, message, buffer).len()
}

#[test]
fn does_not_allocate_after_the_start() {
    let autopilot = UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = Port::open(&"udpin:127.0.0.1:0".parse().unwrap(), Wanted::default()).unwrap();
    let to: std::net::SocketAddr = port.local().unwrap().parse().unwrap();
    let at = |ms: u64| HostTime::from_ns((1000 + ms) * 1_000_000);
    let mut watch = Watch::new(at(0), Wanted::default());
    let mut out = ToPort { port: &port, lands: 0 };
    let (mut up, mut down, mut received) = ([0; MAX_PACKET], [0; MAX_PACKET], [0; 2048]);
    let motion = GuidedMotion::Velocity(DVec3::X);
    let setpoint = GuidedSetpoint { motion, yaw: YawTarget::Angle(0.0) };
    let setpoint =
        MavMessage::SET_POSITION_TARGET_LOCAL_NED(guided_to_mavlink(&setpoint, (1, 1), 0));
    let up_len = packet((255, 191), &setpoint, &mut up);
    let beat = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 4,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        ..HEARTBEAT_DATA::default()
    });
    let down_len = packet((1, 1), &beat, &mut down);
    let mut before = 0;
    for ms in (0..8000).step_by(10) {
        if ms == 1000 {
            before = CountingAllocator::thread_allocations();
        }
        if ms % 500 == 0 {
            autopilot.send_to(&down[..down_len], to).unwrap();
            let len = port.receive(&mut received).unwrap().expect("the autopilot's heartbeat");
            watch.handle_autopilot(at(ms), &received[..len]);
        }
        // The runtime sends for 3 s, then hangs. The server's poses continue.
        if ms < 3000 {
            watch.handle_runtime(at(ms), &up[..up_len], &mut out);
        }
        let pose = PoseSample::still(ServerTime::from_ns(ms * 1_000_000), Pose::IDENTITY);
        watch.handle_pose(at(ms), &pose, at(ms), &mut out);
        watch.handle_timeout(at(ms), &mut out);
    }
    assert_eq!(CountingAllocator::thread_allocations() - before, 0);
    assert!(out.lands > 3, "LAND was sent");
}
