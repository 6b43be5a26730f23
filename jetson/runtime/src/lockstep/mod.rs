//! Driver of the companion on a virtual clock, which waits for the plugin: for graded flights (`vizflyt grade`).
//! Replays use the same [`PluginProcess`].
//!
//! ```text
//! MAVLink bytes, poses, events, now ──▶ Companion ──▶ MAVLink bytes, events
//!                                        │      ▲
//!                       messages, senses ▼      │ reply, a fixed virtual time later
//! images ──▶ observation ──▶ PluginProcess (its own process, confined)
//! ```
//! The caller controls time. Only [`PluginProcess`] blocks, and only for the plugin. Therefore the results depend on
//! the inputs, not on the speed of the computer. Server and companion run on the same computer, with one clock.

mod own_time;
mod process;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;

use serde_json::json;
use vizflyt_protocol::messages::{ArenaInfo, CameraInfo, FromPlugin, Odometry, Setpoint};
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::ObservationWriter;

use crate::companion::{Companion, Senses};
use crate::flight::{FlightSettings, Views};
use crate::link::LinkSettings;
use crate::log::{Channel, GivenImage, LoggedSensors, VirtualLog, observation_head, sent_message};
use crate::odometry::OdometryGate;
use crate::stream::{NewestReadings, Reading, ServerClock};

pub use process::{LineSink, PluginProcess, ProcessError};

/// Reply of a plugin to an observation.
#[derive(Clone, Debug, PartialEq)]
pub struct Reply {
    /// Number of the observation.
    pub seq: u64,
    /// Setpoint, if the plugin sent one.
    pub setpoint: Option<Setpoint>,
}

/// Companion and its plugin's process on a virtual clock; see the module.
#[derive(Debug)]
pub struct Lockstep {
    /// Companion, for inputs and outputs other than the plugin's.
    pub companion: Companion,
    process: Option<PluginProcess>,
    senses: Senses,
    /// Delay from an observation until its reply takes effect. [ns]
    reply_after_ns: i64,
    /// Replies that have not taken effect yet, with the time at which they do.
    replies: VecDeque<(HostTime, Reply)>,
    log: Option<VirtualLog>,
    sensors: Vec<SensorInfo>,
    /// Newest reading of each sensor, for the next observation.
    readings: NewestReadings,
    odometry_gate: OdometryGate,
    /// Estimates of the plugin that the caller has not taken yet.
    odometry: Vec<Odometry>,
}

impl Lockstep {
    /// Creates the companion of a flight in `arena` that begins at `now`; its plugin is `process`, and each reply takes
    /// effect `reply_after_ns` after its observation. [ns]
    pub fn new(
        now: HostTime,
        arena: &ArenaInfo,
        settings: FlightSettings,
        process: Option<PluginProcess>,
        reply_after_ns: i64,
    ) -> Self {
        let link = LinkSettings::default();
        let mut companion = Companion::new(now, settings, link, ServerClock::same());
        companion.handle_arena(now, Box::new(arena.clone()));
        companion.greet_plugin(now);
        let (senses, replies) = (Senses::default(), VecDeque::new());
        let (odometry_gate, odometry) = (OdometryGate::default(), Vec::new());
        Self {
            companion,
            process,
            senses,
            reply_after_ns,
            replies,
            log: None,
            sensors: arena.sensors.to_vec(),
            readings: NewestReadings::default(),
            odometry_gate,
            odometry,
        }
    }

    /// Starts to log this flight.
    pub fn set_log(&mut self, log: VirtualLog) {
        self.log = Some(log);
    }

    /// Returns the log, for data of the caller: poses, events, lines of the plugin.
    pub fn log(&mut self) -> Option<&mut VirtualLog> {
        self.log.as_mut()
    }

    /// Takes the log, to finish it.
    pub fn take_log(&mut self) -> Option<VirtualLog> {
        self.log.take()
    }

    /// Takes the estimates that the plugin has published since the last call.
    pub fn take_odometry(&mut self) -> Vec<Odometry> {
        std::mem::take(&mut self.odometry)
    }

    /// Greets the plugin and waits until it is ready. If the plugin fails, the flight ends.
    ///
    /// # Errors
    /// Returns [`ProcessError`], except for a failure of the plugin.
    pub fn begin(&mut self, now: HostTime, line: LineSink<'_>) -> Result<(), ProcessError> {
        let (Some(process), Some(start)) = (&mut self.process, self.companion.poll_plugin()) else {
            return Ok(());
        };
        if let Some(log) = &mut self.log {
            log.to_plugin(now, &start);
        }
        let result = process.begin(&start, line);
        if self.unless_failed(now, result, line)?.is_some() {
            self.companion.plugin_ready();
        }
        Ok(())
    }

    /// Handles a sensor's reading, which the plugin receives with its next images.
    pub fn take_reading(&mut self, now: HostTime, reading: Reading) {
        self.companion.handle_reading(now, &reading);
        if let Some(newest) = self.readings.get_mut(usize::from(reading.header.sensor)) {
            *newest = Some(Arc::new(reading));
        }
    }

    /// Shows observation `seq` to the plugin and waits for its reply. `write` writes the images; the senses are already
    /// written. `images` are the same images, for the log. Returns `None` after the plugin has ended.
    ///
    /// # Errors
    /// Returns [`ProcessError`], except for a failure of the plugin.
    pub fn show(
        &mut self,
        now: HostTime,
        seq: u64,
        cameras: &[CameraInfo],
        write: impl FnOnce(&mut ObservationWriter<'_>),
        images: &[GivenImage<'_>],
        line: LineSink<'_>,
    ) -> Result<Option<Reply>, ProcessError> {
        while let Some(process) = &mut self.process
            && let Some(message) = self.companion.poll_plugin()
        {
            if let Some(log) = &mut self.log {
                log.to_plugin(now, &message);
            }
            let result = process.send(&message, line);
            self.unless_failed(now, result, line)?;
        }
        let Some(process) = &mut self.process else { return Ok(None) };
        let len =
            ObservationWriter::len_for(cameras) + ObservationWriter::sensors_len(&self.sensors);
        let mut memory = process.loan(len)?;
        let mut writer = ObservationWriter::new(memory.memory(), seq, cameras)?;
        self.companion.update_senses(&mut self.senses);
        self.senses.write(&mut writer);
        write(&mut writer);
        for image in images {
            self.senses.write_pose_at_image(&mut writer, image.header);
        }
        self.senses.write_readings(&mut writer, &self.sensors, &self.readings);
        if let Some(log) = &mut self.log {
            let bytes = memory.memory();
            let sensors = LoggedSensors::of(bytes, &self.sensors, &self.readings);
            log.observation(now, seq, observation_head(bytes), images, &sensors);
        }
        let mut views = Views::default();
        for image in images {
            if let Some(view) = views.get_mut(usize::from(image.header.camera)) {
                *view = Some(image.pose);
            }
        }
        self.companion.published(now, seq, views);
        let result = process.ask(seq, memory, line);
        let published = process.take_odometry();
        for odometry in published.into_iter().filter(|one| self.odometry_gate.takes(now, one)) {
            if let Some(log) = &mut self.log {
                log.odometry(now, &odometry);
            }
            self.odometry.push(odometry);
        }
        let reply = self.unless_failed(now, result, line)?.map(|setpoint| Reply { seq, setpoint });
        if let Some(reply) = &reply {
            self.log_reply(now, reply);
            self.take_reply(now, reply.clone());
        }
        Ok(reply)
    }

    /// Runs everything due at `now`. Call it at least every few milliseconds of virtual time.
    pub fn handle_timeout(&mut self, now: HostTime) {
        while let Some((_, Reply { seq, setpoint })) =
            self.replies.pop_front_if(|(due, _)| *due <= now)
        {
            self.companion.replied(now, seq, setpoint);
        }
        let sent = self.companion.handle_timeout(now);
        if let (Some(log), Some(sent)) = (&mut self.log, sent)
            && let Some(message) = sent_message(&sent.setpoint)
        {
            log.write(Channel::Sent, now, &message);
        }
        while let Some(event) = self.companion.poll_link_event() {
            tracing::debug!("link: {event:?}");
        }
    }

    /// Stops the plugin in an orderly way.
    pub fn stop(&mut self, line: LineSink<'_>) {
        if let Some(process) = self.process.take() {
            process.stop(line);
        }
    }

    /// Handles a reply to an observation that was shown at `now`; it takes effect later.
    pub(crate) fn take_reply(&mut self, now: HostTime, reply: Reply) {
        self.replies.push_back((now.plus_ns(self.reply_after_ns), reply));
    }

    /// Logs a reply to the observation that was shown at `now`: on the virtual clock it took no time. It is written
    /// after the messages sent before it at the same instant, where a replay expects it.
    fn log_reply(&mut self, now: HostTime, reply: &Reply) {
        let Some(log) = &mut self.log else { return };
        let Reply { seq, setpoint } = reply.clone();
        log.write(Channel::Requested, now, &json!({"seq": seq, "setpoint": &setpoint}));
        let entered = now.plus_ns(1);
        log.from_plugin(now, &FromPlugin::Reply { seq, entered, returned: entered, setpoint });
    }

    /// Returns the value, or `None` if the plugin has failed: then it is stopped, and the flight ends.
    fn unless_failed<T>(
        &mut self,
        now: HostTime,
        result: Result<T, ProcessError>,
        line: LineSink<'_>,
    ) -> Result<Option<T>, ProcessError> {
        match result {
            Err(ProcessError::Failed(fault)) => {
                self.stop(line);
                self.companion.plugin_failed(now, *fault);
                Ok(None)
            }
            result => result.map(Some),
        }
    }
}
