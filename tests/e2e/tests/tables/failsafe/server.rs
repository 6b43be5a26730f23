//! The render server: motion capture driver, filter and rules; poses and images for the runtime, poses for the
//! guardian. Images are only stamps, because no plugin here uses pixels.

use std::sync::Arc;

use vizflyt_arena::{ArenaConfig, DistanceField, Referee};
use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_server::poses::drivers::udp::PoseStream;
use vizflyt_server::poses::drivers::vicon::ViconStream;
use vizflyt_server::poses::settings::{Driver, LocalizationConfig};

use super::rig::{OBJECT, Wires, host, server};

/// Period of the images. [ns]
const IMAGE_NS: i64 = 50_000_000;
/// Minimum interval of poses for the runtime, as in the server's session. [s]
const POSE_EVERY_S: f64 = 0.0095;
/// Minimum interval of poses for the guardian, as in the server's feed. [s]
const FED_EVERY_S: f64 = 0.018;

/// Server of one vehicle.
pub(crate) struct Server {
    stream: ViconStream,
    referee: Referee,
    newest: Option<PoseSample>,
    sent: ServerTime,
    fed: ServerTime,
    /// Stamp of the pose of the newest image.
    rendered: ServerTime,
    image_at: HostTime,
}

impl Server {
    pub(crate) fn new(now: HostTime, arena: &ArenaConfig, obstacles: Arc<DistanceField>) -> Self {
        let source = LocalizationConfig::new(Driver::Vicon);
        Self {
            stream: ViconStream::new(&source, 0, &[OBJECT]),
            referee: Referee::new(arena, obstacles).counting_from(server(now)),
            newest: None,
            sent: ServerTime::ZERO,
            fed: ServerTime::ZERO,
            rendered: ServerTime::ZERO,
            image_at: now,
        }
    }

    /// Returns the next time at which the server has work.
    pub(crate) fn due(&self, wires: &Wires) -> Option<HostTime> {
        let image = self.has_unseen_pose().then_some(self.image_at);
        let silence = self.referee.poll_timeout().map(host);
        [wires.capture.due(), wires.imu.due(), wires.reports.due(), image, silence]
            .into_iter()
            .flatten()
            .min()
    }

    /// Returns the speed in the newest pose. [m/s]
    pub(crate) fn speed_mps(&self) -> f64 {
        self.newest.map_or(0.0, |newest| newest.twist.linear_mps.length())
    }

    fn has_unseen_pose(&self) -> bool {
        self.newest.is_some_and(|newest| newest.stamp > self.rendered)
    }

    /// Does all work that is due.
    pub(crate) fn turn(&mut self, now: HostTime, wires: &mut Wires) {
        while let Some(reading) = wires.imu.receive(now) {
            self.referee.handle_imu(&reading);
        }
        while let Some(event) = wires.reports.receive(now) {
            self.referee.handle_event(&event);
        }
        let mut judged_at = None;
        // The kernel stamps packets when they arrive, also during a pause of the server.
        while let Some((at, (port, packet))) = wires.capture.receive_stamped(now) {
            let from = ([127, 0, 0, 1], port).into();
            for measured in self.stream.handle_packet_from(server(at), from, &packet) {
                if let Ok(sample) = self.referee.handle_measurement(&measured.with_covariance()) {
                    self.newest = Some(sample);
                    judged_at = Some(sample.stamp);
                }
            }
        }
        // While poses arrive, their stamps are the time, as in the pose thread.
        self.referee.handle_timeout(judged_at.unwrap_or(server(now)));
        while let Some(event) = self.referee.poll_event() {
            wires.events.send(now, event);
        }
        let Some(newest) = self.newest else { return };
        if newest.stamp.seconds_since(self.sent) >= POSE_EVERY_S {
            self.sent = newest.stamp;
            wires.poses.send(now, newest);
        }
        if newest.stamp.seconds_since(self.fed) >= FED_EVERY_S {
            self.fed = newest.stamp;
            wires.feed.send(now, newest);
        }
        if now >= self.image_at && self.has_unseen_pose() {
            self.rendered = newest.stamp;
            self.image_at = self.image_at.plus_ns(IMAGE_NS).max(now);
            wires.images.send(now, host(newest.stamp));
        }
    }
}
