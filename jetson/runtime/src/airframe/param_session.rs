//! A parameter session with an autopilot: identifies it, reads and writes its parameters, uploads a fence
//! and a signing key. Drives the link's own state machine on one thread.

use std::collections::BTreeMap;
use std::io;
use std::time::{Duration, Instant};

use vizflyt_sdk::host_now;

use super::names::Version;
use crate::link::{
    FenceEvent, FencePolygon, Firmware, Link, LinkEvent, LinkSettings, LinkSigning, ParamEvent,
};
use vizflyt_guardian::port::{MavlinkAddress, Port};

/// Why a session failed.
#[derive(Debug, thiserror::Error)]
pub enum ParamSessionError {
    /// The port cannot be opened.
    #[error("{address}: {why}")]
    Open {
        /// The address.
        address: MavlinkAddress,
        /// The system's reason.
        why: io::Error,
    },
    /// No heartbeat came.
    #[error(
        "no heartbeat from an autopilot on {address} within {within_s} s; check power, link and address"
    )]
    NoHeartbeat {
        /// The address.
        address: MavlinkAddress,
        /// The time limit. [s]
        within_s: f64,
    },
    /// Parameters are missing.
    #[error(
        "the autopilot did not send its parameters within {within_s} s; {received} came; try again nearer or by USB"
    )]
    NoParams {
        /// The time limit. [s]
        within_s: f64,
        /// How many came.
        received: usize,
    },
    /// Motors may turn.
    #[error("the vehicle is armed; land and disarm it before its parameters are written")]
    Armed,
    /// Only ArduCopter's parameters are known.
    #[error("this is {0}; parameter files are for ArduCopter")]
    OtherProgram(Firmware),
}

/// A session with an autopilot that answers.
pub struct ParamSession {
    port: Port,
    link: Link,
}

/// Time limit for a heartbeat; one comes every second. [s]
const HEARTBEAT_WITHIN_S: f64 = 8.0;
/// Time limit for the version, which comes after the streams are set up. [s]
const VERSION_WITHIN_S: f64 = 4.0;
/// Time limit for all parameters: a thousand at 57600 baud, and some lost. [s]
const LIST_WITHIN_S: f64 = 90.0;
/// Time limit for one write; it is requested five times. [s]
const WRITE_WITHIN_S: f64 = 5.0;
/// Time limit for a fence: the origin comes within some seconds of a start, a fence is offered for eight. [s]
const FENCE_WITHIN_S: f64 = 20.0;
/// A message has reached the autopilot by then, over any link. [s]
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

    /// Returns the link, for its state.
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// Returns the version of the parameter names: by the firmware, or by the names themselves.
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
        // The few that a link reads by itself come first.
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

    /// Writes parameters; returns for each the value that the autopilot confirms, `None` without a reply.
    ///
    /// # Errors
    /// [`ParamSessionError::Armed`]; nothing is written then.
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

    /// Uploads polygons as the autopilot's own fence; returns how many it accepts, or why it rejects
    /// them.
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
        let silent = "it has no origin yet; start it in its localization, and try again";
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
        // The autopilot needs time to receive it: a connection closed at once, with unread telemetry in it,
        // is reset, and the key is lost with it.
        self.until(DELIVERY_S, |_, _| None::<()>);
        Ok(())
    }

    /// Runs the link until `done` returns something, for `within_s` at most. `done` is called with every
    /// event, and once per turn without one.
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
            // A failed socket receives nothing; the time limit reports it.
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
