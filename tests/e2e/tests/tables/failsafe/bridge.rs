//! The Wi-Fi bridge between the vehicle's serial line and the network, with the core of the chips' firmware.

use std::net::{Ipv4Addr, SocketAddrV4};

use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

use super::rig::Wires;

/// Address of the guardian's port.
const GUARDIAN: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(192, 168, 4, 2), 14550);

/// A bridge with power.
pub(crate) struct WifiBridge {
    bridge: Bridge,
    /// The bridge hangs: neither it nor its network stack reacts.
    pub(crate) is_hung: bool,
}

impl WifiBridge {
    /// Switches a bridge on.
    pub(crate) fn new(now: HostTime) -> Self {
        let settings = Settings { client: Some(GUARDIAN), ..Settings::default() };
        let chip = Chip { address: [2, 0, 0, 0, 0, 1], random: [7; 16] };
        Self { bridge: Bridge::new(now, settings, chip), is_hung: false }
    }

    /// Returns the next time at which the bridge has work.
    pub(crate) fn due(&self, now: HostTime, wires: &Wires) -> Option<HostTime> {
        if self.is_hung {
            return None;
        }
        let line = wires.uart_to_vehicle.free_at(now);
        let dues = [
            wires.uart_from_vehicle.due(),
            wires.to_vehicle.due(),
            Some(self.bridge.poll_timeout()),
            self.bridge.udp_due(),
            (line > now).then_some(line),
        ];
        dues.into_iter().flatten().min()
    }

    /// Does all work that is due.
    pub(crate) fn turn(&mut self, now: HostTime, wires: &mut Wires) {
        if self.is_hung {
            wires.uart_from_vehicle.clear();
            wires.to_vehicle.clear();
            return;
        }
        while let Some(bytes) = wires.uart_from_vehicle.receive(now) {
            self.bridge.handle_uart(now, &bytes);
        }
        while let Some(datagram) = wires.to_vehicle.receive(now) {
            self.bridge.handle_datagram(now, GUARDIAN, &datagram);
        }
        if self.bridge.poll_timeout() <= now {
            self.bridge.handle_timeout(now);
        }
        let mut packet = [0; MAX_PACKET];
        while wires.uart_to_vehicle.free_at(now) <= now {
            match self.bridge.poll_uart(now, &mut packet) {
                0 => break,
                len => wires.uart_to_vehicle.send_serially(now, &packet[..len]),
            }
        }
        let mut datagram = [0; 1472];
        while let Some((to, len)) = self.bridge.poll_udp(now, &mut datagram) {
            if to == GUARDIAN {
                wires.from_vehicle.send(now, datagram[..len].to_vec());
            }
        }
    }
}
