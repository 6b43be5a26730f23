//! Parameter session with an autopilot: identifies it, reads and writes its parameters, uploads a fence and a signing
//! key. Drives the state machine of the link on one thread.

use std::collections::BTreeMap;
use std::io;
use std::time::{Duration, Instant};

use vizflyt_sdk::host_now;

use super::names::Version;
use crate::link::{
    FenceEvent, FencePolygon, Firmware, Link, LinkEvent, LinkSettings, LinkSigning, ParamEvent,
};
use vizflyt_guardian::port::{IntruderFault, MavlinkAddress, Port};

/// Error of a session.
#[derive(Debug, thiserror::Error)]
pub enum ParamSessionError {
    /// The port cannot be opened.
    #[error("{address}: {why}")]
    Open {
        address: MavlinkAddress,
        /// Error of the operating system.
        why: io::Error,
    },
    /// No heartbeat was received.
    #[error(
        "no heartbeat from an autopilot on {address} within {within_s} s; check power, link and address"
    )]
    NoHeartbeat {
        address: MavlinkAddress,
        /// Timeout. [s]
        within_s: f64,
    },
    /// A vehicle that is no multirotor, or several multirotors; with what to do.
    #[error("{0}")]
    Vehicle(String),
    /// Parameters are missing.
    #[error(
        "the autopilot did not send its parameters within {within_s} s; {received} came; try again nearer or by USB"
    )]
    NoParams {
        /// Timeout. [s]
        within_s: f64,
        /// Number of parameters received.
        received: usize,
    },
    /// The motors may turn.
    #[error("the vehicle is armed; land and disarm it before its parameters are written")]
    Armed,
    /// Parameters are only known for ArduCopter.
    #[error("this is {0}; parameter files are for ArduCopter")]
    OtherProgram(Firmware),
}

/// Session with an autopilot that responds.
pub struct ParamSession {
    port: Port,
    link: Link,
    /// Names of other senders on the link, for the user.
    neighbors: Vec<String>,
    /// Second autopilot that sends to the port from another address.
    second: Option<String>,
}

/// Timeout of a heartbeat; one is sent every second. [s]
const HEARTBEAT_WITHIN_S: f64 = 8.0;
/// Timeout of the version, which arrives after the streams are configured. [s]
const VERSION_WITHIN_S: f64 = 4.0;
/// Timeout of a multirotor's heartbeat, if another vehicle sends heartbeats. [s]
const OTHERS_WITHIN_S: f64 = 3.0;
/// Time in which a second autopilot sends at least one heartbeat. [s]
const ALONE_S: f64 = 1.2;
/// Timeout of all parameters: a thousand at 57600 baud, with losses. [s]
const LIST_WITHIN_S: f64 = 90.0;
/// Timeout of one write, which is requested five times. [s]
const WRITE_WITHIN_S: f64 = 5.0;
/// Timeout of a fence upload: the origin is known some seconds after a start, and a fence is offered for 8 s. [s]
const FENCE_WITHIN_S: f64 = 20.0;
/// Time in which a message reaches the autopilot over every link. [s]
const DELIVERY_S: f64 = 1.0;

impl ParamSession {
    /// Opens the port, and waits for a heartbeat and the version.
    ///
    /// # Errors
    /// [`ParamSessionError::Open`], [`ParamSessionError::NoHeartbeat`], [`ParamSessionError::Vehicle`].
    pub fn open(
        address: &MavlinkAddress,
        settings: LinkSettings,
    ) -> Result<Self, ParamSessionError> {
        let port = Port::open(address, settings.wanted())
            .map_err(|why| ParamSessionError::Open { address: address.clone(), why })?;
        let link = Link::with(host_now(), settings);
        let mut session = Self { port, link, neighbors: Vec::new(), second: None };
        let within_s = HEARTBEAT_WITHIN_S;
        let connected = |_: Option<&LinkEvent>, link: &Link| link.is_connected().then_some(());
        if session.until(OTHERS_WITHIN_S, connected).is_none() {
            if let Some(wrong) = session.link.wrong_vehicle(host_now()) {
                return Err(ParamSessionError::Vehicle(wrong));
            }
            session.until(within_s - OTHERS_WITHIN_S, connected).ok_or_else(|| {
                ParamSessionError::NoHeartbeat { address: address.clone(), within_s }
            })?;
        }
        session.until(ALONE_S, |_, link| link.several(host_now()).map(|_| ()));
        if let Some(several) = session.link.several(host_now()).or_else(|| session.second.take()) {
            return Err(ParamSessionError::Vehicle(several));
        }
        session.until(VERSION_WITHIN_S, |_, link| link.firmware().map(|_| ()));
        Ok(session)
    }

    /// Returns what other senders of heartbeats are on the link, one sentence each.
    pub fn neighbors(&self) -> &[String] {
        &self.neighbors
    }

    /// Returns the link: the state of the autopilot.
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// Returns the version of the parameter names, from the firmware or from the names themselves.
    ///
    /// # Errors
    /// [`ParamSessionError::OtherProgram`].
    pub fn version(&self) -> Result<Version, ParamSessionError> {
        match self.link.firmware() {
            Some(firmware) if firmware.name != "ArduCopter" => {
                Err(ParamSessionError::OtherProgram(firmware))
            }
            Some(firmware) if firmware.version.0 > 0 => Ok(Version::of(firmware)),
            _ => {
                let params = self.link.params();
                Ok(if params.contains_key("MAV_GCS_SYSID") {
                    Version::V48
                } else if params.contains_key("GPS1_TYPE") {
                    Version::V46
                } else {
                    Version::V45
                })
            }
        }
    }

    /// Reads all parameters; returns their values.
    ///
    /// # Errors
    /// [`ParamSessionError::NoParams`].
    pub fn read(&mut self) -> Result<BTreeMap<String, f64>, ParamSessionError> {
        // First wait for the parameters that the link reads automatically.
        self.until(VERSION_WITHIN_S, |_, link| (!link.is_busy_with_params()).then_some(()));
        while self.link.poll_event().is_some() {}
        self.link.read_params(host_now());
        let complete = self.until(LIST_WITHIN_S, |event, _| match event {
            Some(LinkEvent::Param(ParamEvent::Read { lost, .. })) => Some(*lost == 0),
            _ => None,
        });
        let params = self.link.params();
        if complete == Some(true) {
            Ok(params.iter().map(|(name, param)| (name.clone(), param.value)).collect())
        } else {
            Err(ParamSessionError::NoParams { within_s: LIST_WITHIN_S, received: params.len() })
        }
    }

    /// Writes parameters; returns for each the value confirmed by the autopilot, `None` without a reply.
    ///
    /// # Errors
    /// [`ParamSessionError::Armed`]; then nothing is written.
    pub fn write(
        &mut self,
        values: &[(String, f64)],
    ) -> Result<Vec<(String, Option<f64>)>, ParamSessionError> {
        let mut written = Vec::new();
        for (name, value) in values {
            if self.link.state().armed {
                return Err(ParamSessionError::Armed);
            }
            self.link.write_param(host_now(), name, *value);
            let has = self.until(WRITE_WITHIN_S, |event, _| match event {
                Some(LinkEvent::Param(ParamEvent::Written { name: done, value }))
                    if done == name =>
                {
                    Some(Some(*value))
                }
                Some(LinkEvent::Param(ParamEvent::NotWritten { name: done, has, .. }))
                    if done == name =>
                {
                    Some(*has)
                }
                _ => None,
            });
            written.push((name.clone(), has.flatten()));
        }
        Ok(written)
    }

    /// Uploads polygons as the autopilot's own fence; returns the number of accepted polygons, or the reason for a
    /// rejection.
    ///
    /// # Errors
    /// [`ParamSessionError::Armed`].
    pub fn upload_fence(
        &mut self,
        polygons: Vec<FencePolygon>,
    ) -> Result<Result<usize, String>, ParamSessionError> {
        if self.link.state().armed {
            return Err(ParamSessionError::Armed);
        }
        self.link.set_fence(host_now(), polygons);
        let done = self.until(FENCE_WITHIN_S, |event, _| match event {
            Some(LinkEvent::Fence(FenceEvent::Accepted(polygons))) => Some(Ok(*polygons)),
            Some(LinkEvent::Fence(FenceEvent::Rejected(why))) => Some(Err(why.clone())),
            _ => None,
        });
        let silent = "it has no origin yet; start it in the localization volume, and try again";
        Ok(done.unwrap_or_else(|| Err(silent.to_owned())))
    }

    /// Sends the signing key, or turns signing off with `None`.
    ///
    /// # Errors
    /// [`ParamSessionError::Armed`].
    pub fn sign(&mut self, signing: Option<&LinkSigning>) -> Result<(), ParamSessionError> {
        if self.link.state().armed {
            return Err(ParamSessionError::Armed);
        }
        self.link.setup_signing(host_now(), signing);
        // Wait until the autopilot has received the message: a connection that is closed at once, with unread
        // telemetry, is reset, and the key is lost.
        self.until(DELIVERY_S, |_, _| None::<()>);
        Ok(())
    }

    /// Runs the link until `done` returns a value, for at most `within_s`. Calls `done` with every event, and once per
    /// turn without one.
    fn until<T>(
        &mut self,
        within_s: f64,
        mut done: impl FnMut(Option<&LinkEvent>, &Link) -> Option<T>,
    ) -> Option<T> {
        let end = Instant::now() + Duration::from_secs_f64(within_s);
        let mut buffer = [0; 2048];
        while Instant::now() < end {
            self.link.handle_timeout(host_now());
            self.transmit();
            if let Some(intruder) = self.port.poll_intruder() {
                tracing::warn!("mavlink: {intruder}");
                if let IntruderFault::SecondAutopilot { .. } = intruder.fault {
                    self.second = Some(intruder.to_string());
                }
            }
            // A failed socket receives nothing; the timeout reports it.
            if let Ok(Some(len)) = self.port.receive(&mut buffer) {
                self.link.handle_input(host_now(), &buffer[..len]);
                self.transmit();
            }
            while let Some(event) = self.link.poll_event() {
                if let LinkEvent::Neighbor(text) = &event {
                    self.neighbors.push(text.clone());
                }
                if let Some(result) = done(Some(&event), &self.link) {
                    return Some(result);
                }
            }
            if let Some(result) = done(None, &self.link) {
                return Some(result);
            }
        }
        None
    }

    fn transmit(&mut self) {
        while let Some(datagram) = self.link.poll_transmit() {
            self.port.send(&datagram);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use vizflyt_protocol::mavlink::dialect::{HEARTBEAT_DATA, MavAutopilot, MavMessage, MavType};
    use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, encode};

    /// Opens a session with the senders of these heartbeats (system, type), each with its own address.
    fn open_with(
        vehicles: &[(u8, MavType)],
        settings: LinkSettings,
    ) -> Result<ParamSession, String> {
        let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let is_done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            for &(system, mavtype) in vehicles {
                let is_done = &is_done;
                scope.spawn(move || {
                    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
                    let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
                    let beat = HEARTBEAT_DATA { mavtype, autopilot, ..Default::default() };
                    let header =
                        MavHeader { system_id: system.into(), component_id: 1, sequence: 0 };
                    let mut bytes = [0; MAX_PACKET];
                    let packet = encode(header, &MavMessage::HEARTBEAT(beat), &mut bytes);
                    while !is_done.load(Ordering::Relaxed) {
                        let _ = socket.send_to(packet, ("127.0.0.1", port));
                        std::thread::sleep(Duration::from_millis(50));
                    }
                });
            }
            let address = format!("udpin:127.0.0.1:{port}").parse().unwrap();
            let session = ParamSession::open(&address, settings);
            is_done.store(true, Ordering::Relaxed);
            session.map_err(|error| error.to_string())
        })
    }

    #[test]
    fn refuses_another_vehicle_and_two_multirotors() {
        let usual = LinkSettings::default;
        let rover = open_with(&[(3, MavType::MAV_TYPE_GROUND_ROVER)], usual()).err().unwrap();
        assert!(rover.contains("system 3 is a rover, not a multirotor"), "{rover}");
        let copters = [(1, MavType::MAV_TYPE_QUADROTOR), (2, MavType::MAV_TYPE_HEXAROTOR)];
        let two = open_with(&copters, usual()).err().unwrap();
        assert!(two.contains("system 1") && two.contains("system 2"), "{two}");
        assert!(two.contains("select one with `system`"), "{two}");
        let selected = LinkSettings { system: Some(2), ..usual() };
        assert_eq!(open_with(&copters, selected).unwrap().link().system(), Some(2));
    }
}
