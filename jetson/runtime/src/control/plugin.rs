//! Plugin in the control loop: its process and shared memory, and when it is started, restarted, monitored and given
//! up.

use std::ffi::OsString;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use vizflyt_protocol::flight_end::PluginFault;
use vizflyt_protocol::messages::{CameraInfo, Setpoint, ToPlugin};
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::ObservationWriter;
use vizflyt_sdk::ipc::{Offer, RuntimeEnd};

use super::{ControlInput, ControlLoop};
use crate::images::ImagePublisher;
use crate::replies::PluginReplies;
use crate::supervisor::{Confinement, PluginEvent, Restart, Supervisor};

/// Time in which a plugin that reported a failure may still print the reason, before it is restarted. [s]
const LAST_WORDS_S: f64 = 0.3;
/// Silence of an attached plugin after which the vehicle holds. Shorter than the guard's 0.5 s of silence, after which
/// the vehicle would hold and later land. [s]
const BREAKPOINT_S: f64 = 0.4;

/// State of the plugin, once the arena is known.
pub(super) struct PluginSide {
    pub(super) ipc: Arc<RuntimeEnd>,
    pub(super) command: Vec<OsString>,
    pub(super) confinement: Confinement,
    pub(super) supervisor: Option<Supervisor>,
    /// Offer to plugins started by hand, until one has attached.
    pub(super) offer: Option<Offer>,
    /// Time of the last reply of a plugin started by hand, or of our reply in its place.
    pub(super) by_hand_replied: Option<HostTime>,
    /// Number of the current process.
    pub(super) run: u32,
    /// Deadline for the current process to end by itself, if it is ending and will be replaced.
    pub(super) leaving: Option<HostTime>,
    pub(super) replies: Arc<PluginReplies>,
    /// Signals its threads to end.
    pub(super) stop: Arc<AtomicBool>,
    pub(super) threads: Vec<JoinHandle<()>>,
}

impl ControlLoop {
    /// Creates the plugin's shared memory and threads, and starts its process. Does nothing before the arena is known.
    pub(super) fn start_plugin(&mut self, now: HostTime) {
        let Some(arena) = self.companion.arena() else { return };
        let (cameras, sensors) = (arena.cameras.to_vec(), arena.sensors.to_vec());
        if let Some(camera) = cameras.first() {
            self.image_size_px = (camera.intrinsics.width_px, camera.intrinsics.height_px);
        }
        let len = ObservationWriter::len_for(&cameras) + ObservationWriter::sensors_len(&sensors);
        let command = self.control.plugin_command.clone();
        let confinement = Confinement::prepare(&self.control.plugin_limits, &command);
        let by_hand = command.is_empty();
        let ipc = Arc::new(RuntimeEnd::new(len));
        let stop = Arc::default();
        let replies = Arc::new(PluginReplies::new(Arc::clone(&ipc)));
        let threads = self.start_threads(&ipc, cameras, sensors, &stop, &replies);
        let mut offer = None;
        if by_hand {
            match ipc.offer() {
                Ok(made) => offer = Some(made),
                Err(error) => {
                    let error = anyhow::Error::new(error);
                    let sentence = format!("cannot offer this runtime to plugins: {error:#}");
                    self.companion.plugin_failed(now, PluginFault::ended(&sentence));
                }
            }
        }
        self.plugin = Some(PluginSide {
            ipc,
            command,
            confinement,
            supervisor: None,
            offer,
            by_hand_replied: None,
            run: 0,
            leaving: None,
            replies,
            stop,
            threads,
        });
        if by_hand {
            let text = "waiting for a plugin: start yours, for example `python my_plugin.py`";
            self.companion.note(now, text);
        } else {
            self.start_process(now);
        }
    }

    /// Reports the activity of a silent plugin's process: when the vehicle lands because of its silence, and at the
    /// holds 1, 2, 4, 8 ...
    pub(super) fn explain_silence(&mut self, now: HostTime) {
        let Some((image, since, lands)) = self.companion.flight().silence() else { return };
        if self.explained.replace((image, lands)) == Some((image, lands)) {
            return;
        }
        self.silences += u64::from(!lands);
        if !(lands || self.silences.is_power_of_two()) {
            return;
        }
        let supervisor = self.plugin.as_ref().and_then(|side| side.supervisor.as_ref());
        if let Some(spent) = supervisor.and_then(|supervisor| supervisor.time_spent(since)) {
            self.companion.note(now, &format!("image {image}: {spent}"));
        }
    }

    /// Monitors a plugin started by hand: detects its end, and holds instead of landing while it is at a breakpoint.
    pub(super) fn tend_by_hand(&mut self, now: HostTime) {
        let Some(side) = &mut self.plugin else { return };
        let Some(answered) = side.by_hand_replied else { return };
        if !side.ipc.plugin_attached() {
            side.by_hand_replied = None;
            let sentence = "the attached plugin has ended".to_owned();
            return self.companion.plugin_failed(now, PluginFault::ended(&sentence));
        }
        if now.seconds_since(answered) > BREAKPOINT_S {
            side.by_hand_replied = Some(now);
            self.companion.replied(now, self.image_seq, Some(Setpoint::Hold));
        }
    }

    /// Starts the plugin's process, the first or a later one.
    pub(super) fn start_process(&mut self, now: HostTime) {
        let Some(side) = &mut self.plugin else { return };
        let (sender, replies, run) = (self.sender.clone(), Arc::clone(&side.replies), side.run);
        // Lines and exits are never dropped: the loop always reads.
        let handle = move |event| {
            if let PluginEvent::Exited(_) = &event {
                // Handle its last messages before its exit: they may contain the reason.
                replies.drain(|message| {
                    let _ = sender.send(ControlInput::FromPlugin(Box::new(message)));
                });
            }
            let _ = sender.send(ControlInput::Plugin(run, event));
        };
        let started = side.ipc.connect().map_err(io::Error::other).and_then(|socket| {
            Supervisor::start(&side.command, &side.confinement, Some(socket), handle)
        });
        match started {
            Ok(supervisor) => side.supervisor = Some(supervisor),
            Err(error) => {
                let program = side.command[0].to_string_lossy();
                let sentence = format!("the plugin {program} cannot be started: {error}");
                self.companion.plugin_failed(now, PluginFault::ended(&sentence));
            }
        }
    }

    /// Handles a failure reported by the plugin; its process ends soon after.
    pub(super) fn plugin_failed(&mut self, now: HostTime, sentence: String) {
        if self.plugin.as_ref().is_some_and(|side| side.leaving.is_some()) {
            return;
        }
        if self.may_restart() {
            self.restarts += 1;
            self.replace_plugin(now, sentence);
        } else {
            self.companion.plugin_failed(now, PluginFault::ended(&sentence));
        }
    }

    pub(super) fn plugin_exited(&mut self, now: HostTime, run: u32, sentence: String) {
        let Some(side) = &mut self.plugin else { return };
        if side.run != run {
            return;
        }
        side.ipc.clean_up();
        if side.leaving.is_none() {
            self.plugin_failed(now, sentence);
        }
        let Some(side) = &mut self.plugin else { return };
        if side.leaving.take().is_some() && self.companion.flight().can_wait_for_plugin() {
            side.run += 1;
            self.companion.plugin_gone();
            side.replies.restart();
            self.start_process(now);
        }
    }

    /// Whether the policy allows a restart of a failed plugin.
    pub(super) fn may_restart(&self) -> bool {
        let (limits, flight) = (&self.control.plugin_limits, self.companion.flight());
        let is_there = match limits.restart {
            Restart::Never => false,
            Restart::OnGround => flight.is_on_ground(),
            Restart::InFlight => true,
        };
        // Plugins started by hand are not restarted.
        let ours = !self.control.plugin_command.is_empty();
        ours && is_there && self.restarts < limits.restarts && flight.can_wait_for_plugin()
    }

    /// Restarts the plugin after its current process has ended; until then the vehicle holds.
    pub(super) fn replace_plugin(&mut self, now: HostTime, why: String) {
        let Some(side) = &mut self.plugin else { return };
        if side.leaving.is_some() || !self.companion.flight().can_wait_for_plugin() {
            return;
        }
        side.leaving = Some(now.plus_seconds(LAST_WORDS_S));
        if side.ipc.plugin_attached() {
            let _ = side.ipc.send(&ToPlugin::Stop);
        }
        self.companion.plugin_restarts(now, why);
    }

    pub(super) fn start_threads(
        &self,
        ipc: &Arc<RuntimeEnd>,
        cameras: Vec<CameraInfo>,
        sensors: Vec<SensorInfo>,
        stop: &Arc<AtomicBool>,
        replies: &Arc<PluginReplies>,
    ) -> Vec<JoinHandle<()>> {
        let mailbox = Arc::clone(&self.control.shared.mailbox);
        let publisher = ImagePublisher::new(Arc::clone(ipc), cameras, Arc::clone(&self.senses))
            .with_log(self.control.log.images(&mailbox))
            .with_sensors(sensors, Arc::clone(&self.control.shared.readings));
        let (sender, stopped) = (self.sender.clone(), Arc::clone(stop));
        let images = spawn("images", move || {
            publisher.run(
                &mailbox,
                || stopped.load(Ordering::Relaxed),
                |published| {
                    let _ = sender.send(ControlInput::Published(published));
                },
            );
        });
        let (replies, sender, stopped) =
            (Arc::clone(replies), self.sender.clone(), Arc::clone(stop));
        let reader = spawn("replies", move || {
            replies.read(&stopped, |message| {
                let _ = sender.send(ControlInput::FromPlugin(Box::new(message)));
            });
        });
        images.into_iter().chain(reader).collect()
    }

    /// Greets the plugin after it has attached.
    pub(super) fn tend_plugin(&mut self, now: HostTime) {
        let Some(side) = &mut self.plugin else { return };
        if side.leaving.is_some_and(|until| now > until)
            && let Some(supervisor) = &side.supervisor
        {
            supervisor.kill();
        }
        let is_greeted = self.companion.is_plugin_greeted();
        if !is_greeted && side.leaving.is_none() && side.ipc.plugin_attached() {
            if side.offer.take().is_some() {
                side.by_hand_replied = Some(now);
            }
            self.companion.greet_plugin(now);
        }
    }

    /// Sends a message to the plugin, if it is attached.
    pub(super) fn send_to_plugin(&self, now: HostTime, message: &ToPlugin) {
        let Some(side) = self.plugin.as_ref().filter(|side| side.ipc.plugin_attached()) else {
            return;
        };
        self.control.log.to_plugin(now, message);
        if let Err(error) = side.ipc.send(message) {
            // A plugin that reads nothing is detected by its silence.
            tracing::debug!("plugin: {error}");
        }
    }
}

fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> Option<JoinHandle<()>> {
    let thread = thread::Builder::new().name(name.into()).spawn(run);
    thread.inspect_err(|error| tracing::error!("thread {name}: {error}")).ok()
}
