//! A short conversation with an autopilot: who it is, what it has, what it is to have. The link's own
//! state machine, driven by one thread.

use std::collections::BTreeMap;
use std::io;
use std::time::{Duration, Instant};

use vizflyt_sdk::host_now;

use super::names::Version;
use crate::link::port::{MavlinkAddress, Port};
use crate::link::{
    FenceEvent, FencePolygon, Firmware, Link, LinkEvent, LinkSettings, LinkSigning, ParamEvent,
};

/// Why a visit came to nothing.
#[derive(Debug, thiserror::Error)]
pub enum VisitError {
    /// The way cannot be opened.
    #[error("{address}: {why}")]
    Way {
        /// Which.
        address: MavlinkAddress,
        /// The system's reason.
        why: io::Error,
    },
    /// Nobody answers.
    #[error(
        "no heartbeat from an autopilot on {address} within {within_s} s; check power, link and address"
    )]
    Nobody {
        /// Where.
        address: MavlinkAddress,
        /// How long was waited. [s]
        within_s: f64,
    },
    /// The reading was not completed.
    #[error(
        "the autopilot did not send its parameters within {within_s} s; {have} have come, try again nearer or by USB"
    )]
    NoParams {
        /// How long was waited. [s]
        within_s: f64,
        /// How many came.
        have: usize,
    },
    /// Motors may turn.
    #[error("the vehicle is armed; land and disarm it before its parameters are written")]
    Armed,
    /// Only ArduCopter's parameters are known.
    #[error("this is {0}; parameter files are for ArduCopter")]
    OtherProgram(Firmware),
}

/// An autopilot that answers.
pub struct Visit {
    port: Port,
    link: Link,
}

/// Heartbeats come every second.
const GREETING_S: f64 = 8.0;
/// The version comes after the streams are set up.
const VERSION_S: f64 = 4.0;
/// A thousand parameters at 57600 baud, and some lost.
const LIST_S: f64 = 90.0;
/// A value is asked for five times.
const WRITE_S: f64 = 5.0;
/// The origin comes within some seconds of a start, and a fence is offered for eight.
const FENCE_S: f64 = 20.0;
/// A message is with the autopilot by then, over any link. [s]
const TAKES_S: f64 = 1.0;

impl Visit {
    /// Finds the autopilot.
    ///
    /// # Errors
    /// [`VisitError::Way`], [`VisitError::Nobody`].
    pub fn open(address: &MavlinkAddress, settings: LinkSettings) -> Result<Self, VisitError> {
        let port =
            Port::open(address).map_err(|why| VisitError::Way { address: address.clone(), why })?;
        let mut visit = Self { port, link: Link::with(host_now(), settings) };
        let within_s = GREETING_S;
        visit
            .until(within_s, |_, link| link.is_connected().then_some(()))
            .ok_or_else(|| VisitError::Nobody { address: address.clone(), within_s })?;
        visit.until(VERSION_S, |_, link| link.firmware().map(|_| ()));
        Ok(visit)
    }

    /// Returns the link, to ask what it knows.
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// Returns which names the autopilot uses: by its version, or by the names themselves.
    ///
    /// # Errors
    /// [`VisitError::OtherProgram`].
    pub fn version(&self) -> Result<Version, VisitError> {
        match self.link.firmware() {
            Some(firmware) if firmware.name != "ArduCopter" => {
                Err(VisitError::OtherProgram(firmware))
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
    /// [`VisitError::NoParams`].
    pub fn read(&mut self) -> Result<BTreeMap<String, f64>, VisitError> {
        // The few that a link reads by itself come first.
        self.until(VERSION_S, |_, link| (!link.is_busy_with_params()).then_some(()));
        while self.link.poll_event().is_some() {}
        self.link.read_params(host_now());
        let complete = self.until(LIST_S, |event, _| match event {
            Some(LinkEvent::Param(ParamEvent::Read { lost, .. })) => Some(*lost == 0),
            _ => None,
        });
        let params = self.link.params();
        if complete == Some(true) {
            Ok(params.iter().map(|(name, param)| (name.clone(), param.value)).collect())
        } else {
            Err(VisitError::NoParams { within_s: LIST_S, have: params.len() })
        }
    }

    /// Writes parameters; returns for each what the autopilot has then, `None` without an answer.
    ///
    /// # Errors
    /// [`VisitError::Armed`]; nothing is written then.
    pub fn write(
        &mut self,
        values: &[(String, f64)],
    ) -> Result<Vec<(String, Option<f64>)>, VisitError> {
        let mut written = Vec::new();
        for (name, value) in values {
            if self.link.state().armed {
                return Err(VisitError::Armed);
            }
            self.link.write_param(host_now(), name, *value);
            let has = self.until(WRITE_S, |event, _| match event {
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

    /// Has the autopilot keep these polygons as its own fence; returns how many it keeps, or why it does
    /// not.
    ///
    /// # Errors
    /// [`VisitError::Armed`].
    pub fn upload_fence(
        &mut self,
        polygons: Vec<FencePolygon>,
    ) -> Result<Result<usize, String>, VisitError> {
        if self.link.state().armed {
            return Err(VisitError::Armed);
        }
        self.link.set_fence(host_now(), polygons);
        let done = self.until(FENCE_S, |event, _| match event {
            Some(LinkEvent::Fence(FenceEvent::Kept(polygons))) => Some(Ok(*polygons)),
            Some(LinkEvent::Fence(FenceEvent::NotKept(why))) => Some(Err(why.clone())),
            _ => None,
        });
        let silent = "it has no origin yet; start it in its localization, and try again";
        Ok(done.unwrap_or_else(|| Err(silent.to_owned())))
    }

    /// Hands the key for signing over, or takes signing back.
    ///
    /// # Errors
    /// [`VisitError::Armed`].
    pub fn sign(&mut self, signing: Option<&LinkSigning>) -> Result<(), VisitError> {
        if self.link.state().armed {
            return Err(VisitError::Armed);
        }
        self.link.setup_signing(host_now(), signing);
        // The autopilot gets the time to take it: a connection closed at once, with telemetry in it that
        // nobody has read, is reset, and the key is lost with it.
        self.until(TAKES_S, |_, _| None::<()>);
        Ok(())
    }

    /// Talks until `done` returns something, `within_s` at most. It is asked at every event, and once
    /// without one at every turn.
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
            // A socket in trouble is silent; the time limit says so.
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
