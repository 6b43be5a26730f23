//! Senders of heartbeats other than the autopilot: further multirotors, other vehicles, and devices such as gimbals.

use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, MavType};
use vizflyt_protocol::mavlink::{HeartbeatSender, heartbeat_sender, heartbeat_sender_name};
use vizflyt_protocol::time::HostTime;

use super::{LOST_AFTER_S, Target};

/// Maximum number of neighbors stored, and of neighbors reported.
const MAX_NEIGHBORS: usize = 16;

#[derive(Clone, Copy, Debug)]
struct Neighbor {
    from: Target,
    mavtype: MavType,
    sender: HeartbeatSender,
    received_at: HostTime,
}

impl Neighbor {
    fn is_multirotor(&self) -> bool {
        matches!(self.sender, HeartbeatSender::Multirotor { .. })
    }

    fn name(&self) -> &'static str {
        heartbeat_sender_name(self.from.component, self.mavtype)
    }
}

/// Neighbors on the link.
#[derive(Clone, Debug, Default)]
pub(super) struct Neighbors {
    seen: Vec<Neighbor>,
    /// Number of neighbors reported.
    reported: usize,
}

impl Neighbors {
    /// Records a heartbeat. Returns a line about its sender when it is seen for the first time, unless it is a
    /// multirotor.
    pub(super) fn heartbeat(
        &mut self,
        now: HostTime,
        from: Target,
        heartbeat: &HEARTBEAT_DATA,
    ) -> Option<String> {
        let mavtype = heartbeat.mavtype;
        let sender = heartbeat_sender(from.component, mavtype as u8, heartbeat.autopilot as u8);
        let neighbor = Neighbor { from, mavtype, sender, received_at: now };
        let known = self.seen.iter_mut().find(|known| known.from == from);
        let is_new = known.as_ref().is_none_or(|known| known.mavtype != mavtype);
        if let Some(known) = known {
            *known = neighbor;
        } else {
            if self.seen.len() >= MAX_NEIGHBORS {
                // Multirotors last: a flood of other senders must not hide them.
                let key =
                    |(_, known): &(usize, &Neighbor)| (known.is_multirotor(), known.received_at);
                let evicted = self.seen.iter().enumerate().min_by_key(key).map_or(0, |(at, _)| at);
                self.seen.swap_remove(evicted);
            }
            self.seen.push(neighbor);
        }
        if !is_new || neighbor.is_multirotor() || self.reported >= MAX_NEIGHBORS {
            return None;
        }
        self.reported += 1;
        let (name, Target { system, component }) = (neighbor.name(), from);
        Some(format!(
            "{name} (system {system}, component {component}) is on the link; it is left alone"
        ))
    }

    /// Removes the sender that has become the autopilot.
    pub(super) fn remove(&mut self, from: Target) {
        self.seen.retain(|known| known.from != from);
    }

    fn here(&self, now: HostTime) -> impl Iterator<Item = &Neighbor> {
        self.seen.iter().filter(move |known| now.seconds_since(known.received_at) < LOST_AFTER_S)
    }

    /// Returns the system ids of other multirotors, in ascending order.
    pub(super) fn multirotors(&self, now: HostTime) -> Vec<u8> {
        let multirotors = self.here(now).filter(|known| known.is_multirotor());
        let mut systems: Vec<u8> = multirotors.map(|known| known.from.system).collect();
        systems.sort_unstable();
        systems
    }

    /// Returns why another vehicle on the link cannot be flown, and what to do.
    pub(super) fn wrong_vehicle(&self, now: HostTime) -> Option<String> {
        let vehicle = self.here(now).find(|known| known.sender == HeartbeatSender::OtherVehicle)?;
        let (system, name) = (vehicle.from.system, vehicle.name());
        let is_copter = |firmware: u8| {
            let sender = heartbeat_sender(vehicle.from.component, vehicle.mavtype as u8, firmware);
            matches!(sender, HeartbeatSender::Multirotor { .. })
        };
        Some(if vehicle.mavtype == MavType::MAV_TYPE_GENERIC {
            format!(
                "system {system} does not report its type of vehicle; set FRAME_CLASS (ArduPilot) or SYS_AUTOSTART \
                 (PX4), and restart the autopilot"
            )
        } else if is_copter(ARDUPILOT) {
            format!(
                "system {system} is {name} whose firmware is neither ArduPilot nor PX4; install ArduCopter"
            )
        } else {
            format!(
                "system {system} is {name}, not a multirotor; connect the autopilot of a multirotor, or set its \
                 address with --mavlink"
            )
        })
    }
}

const ARDUPILOT: u8 =
    vizflyt_protocol::mavlink::dialect::MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA as u8;
