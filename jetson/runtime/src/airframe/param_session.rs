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
use vizflyt_guardian::port::{MavlinkAddress, Port};

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
}

/// Timeout of a heartbeat; one is sent every second. [s]
const HEARTBEAT_WITHIN_S: f64 = 8.0;
/// Timeout of the version, which arrives after the streams are configured. [s]
const VERSION_WITHIN_S: f64 = 4.0;
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
    /// [`ParamSessionError::Open`], [`ParamSessionError::NoHeartbeat`].
    pub fn open(
        address: &MavlinkAddress,
        settings: LinkSettings,
    ) -> Result<Self, ParamSessionError> {
        let port = Port::open(address, settings.wanted())
            .map_err(|why| ParamSessionError::Open { address: address.clone(), why })?;
        let mut session = Self { port, link: Link::with(host_now(), settings) };
        let within_s = HEARTBEAT_WITHIN_S;
        session
            .until(within_s, |_, link| link.is_connected().then_some(()))
            .ok_or_else(|| ParamSessionError::NoHeartbeat { address: address.clone(), within_s })?;
        session.until(VERSION_WITHIN_S, |_, link| link.firmware().map(|_| ()));
        Ok(session)
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
            }
            // A failed socket receives nothing; the timeout reports it.
            if let Ok(Some(len)) = self.port.receive(&mut buffer) {
                self.link.handle_input(host_now(), &buffer[..len]);
                self.transmit();
            }
            while let Some(event) = self.link.poll_event() {
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
