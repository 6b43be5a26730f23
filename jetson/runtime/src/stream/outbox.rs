//! Queue of messages to the server: the newest report, and each event until the server has acknowledged it,
//! across reconnects.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard};
use vizflyt_process::lock;

use tokio::sync::Notify;
use vizflyt_protocol::messages::{
    Event, EventKind, Guarded, ImuReading, MAX_IMU_BATCH, Telemetry, Timing, ToServer,
};

/// Reports and events that wait to be sent to the server.
#[derive(Debug, Default)]
pub struct Outbox {
    inner: Mutex<Inner>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct Inner {
    report: Option<Telemetry>,
    timing: Option<Timing>,
    /// Limits that the guard applies; kept for the next connection.
    guarded: Option<Guarded>,
    /// Whether `guarded` must still be sent on the present connection.
    guarded_due: bool,
    /// Unsent readings of the IMU, oldest first.
    imu: heapless::Vec<ImuReading, MAX_IMU_BATCH>,
    /// Unacknowledged events, oldest first.
    events: VecDeque<(u64, Event)>,
    /// Number of the newest event.
    made: u64,
    /// Number of the newest event written on the present connection.
    written: u64,
    closed: bool,
}

/// Number of IMU readings per message: 50 messages a second at 100 Hz, with a delay of at most 20 ms.
const IMU_TOGETHER: usize = 2;

/// Next step of the writer.
#[allow(clippy::large_enum_variant)] // Why: it is taken apart at once.
enum Next {
    Send(ToServer),
    Wait,
    End,
}

impl Outbox {
    /// Maximum number of events, equal to that of the server's log. Above it, the oldest printed line of the
    /// plugin is dropped, or without such lines the oldest event.
    pub const MAX_EVENTS: usize = 4096;

    /// Queues a report; replaces an unsent one.
    pub fn report(&self, report: Telemetry) {
        self.lock().report = Some(report);
        self.changed.notify_one();
    }

    /// Queues a report of the stages of the image age; replaces an unsent one.
    pub fn report_timing(&self, timing: Timing) {
        self.lock().timing = Some(timing);
        self.changed.notify_one();
    }

    /// Queues the guard's limits, for this connection and for each later one.
    pub fn report_guarded(&self, guarded: Guarded) {
        let mut inner = self.lock();
        inner.guarded_due |= inner.guarded != Some(guarded);
        inner.guarded = Some(guarded);
        drop(inner);
        self.changed.notify_one();
    }

    /// Queues a reading of the autopilot's IMU. If a batch is full, drops the oldest reading.
    pub fn imu(&self, reading: ImuReading) {
        let mut inner = self.lock();
        if inner.imu.is_full() {
            inner.imu.remove(0);
        }
        // Cannot fail: a place is free.
        let _ = inner.imu.push(reading);
        let is_due = inner.imu.len() >= IMU_TOGETHER;
        drop(inner);
        if is_due {
            self.changed.notify_one();
        }
    }

    /// Queues an event until the server has acknowledged it.
    pub fn send_event(&self, event: Event) {
        let mut inner = self.lock();
        inner.made += 1;
        let seq = inner.made;
        inner.events.push_back((seq, event));
        if inner.events.len() > Self::MAX_EVENTS {
            let is_line = |(_, event): &(u64, Event)| event.kind == EventKind::PluginOutput;
            let at = inner.events.iter().position(is_line).unwrap_or(0);
            if let Some((seq, event)) = inner.events.remove(at) {
                tracing::warn!(
                    "the server has been unreachable for too long: event {seq} is lost: {}",
                    event.text
                );
            }
        }
        drop(inner);
        self.changed.notify_one();
    }

    /// Closes the queue at the end of the flight.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_one();
    }

    /// Begins a new connection, whose server has received events up to number `received`. Discards
    /// reports, which are stale.
    pub(super) fn resume(&self, received: u64) {
        let mut inner = self.lock();
        inner.forget(received);
        inner.written = received;
        (inner.report, inner.timing) = (None, None);
        inner.guarded_due = inner.guarded.is_some();
        inner.imu.clear();
    }

    /// Removes events up to number `seq`, which the server has acknowledged.
    pub(super) fn acknowledged(&self, seq: u64) {
        self.lock().forget(seq);
        self.changed.notify_one();
    }

    /// Returns the next message, events first; `None` after the close when all events are acknowledged.
    pub(super) async fn next(&self) -> Option<ToServer> {
        loop {
            match self.lock().take() {
                Next::Send(message) => return Some(message),
                Next::End => return None,
                Next::Wait => {}
            }
            self.changed.notified().await;
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Why: nothing panics while the lock is held.
        lock(&self.inner)
    }
}

impl Inner {
    fn forget(&mut self, received: u64) {
        while self.events.front().is_some_and(|&(seq, _)| seq <= received) {
            self.events.pop_front();
        }
    }

    fn take(&mut self) -> Next {
        let at = self.events.partition_point(|&(seq, _)| seq <= self.written);
        if let Some((seq, event)) = self.events.get(at).cloned() {
            self.written = seq;
            return Next::Send(ToServer::Event { seq, event });
        }
        if let Some(report) = self.report.take() {
            return Next::Send(ToServer::Telemetry(report));
        }
        if self.imu.len() >= IMU_TOGETHER {
            return Next::Send(ToServer::Imu(std::mem::take(&mut self.imu)));
        }
        if let Some(timing) = self.timing.take() {
            return Next::Send(ToServer::Timing(timing));
        }
        if let Some(guarded) = self.guarded.filter(|_| std::mem::take(&mut self.guarded_due)) {
            return Next::Send(ToServer::Guarded(guarded));
        }
        if self.closed && self.events.is_empty() { Next::End } else { Next::Wait }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::bounded;
    use vizflyt_protocol::time::ServerTime;

    fn event(kind: EventKind, text: &str) -> Event {
        Event { stamp: ServerTime::ZERO, kind, text: bounded(text) }
    }

    /// Takes all messages that are ready: the number of an event, `R` a report, `-` the end.
    fn written(outbox: &Outbox) -> String {
        let mut found = Vec::new();
        loop {
            let next = outbox.lock().take();
            found.push(match next {
                Next::Send(ToServer::Event { seq, .. }) => seq.to_string(),
                Next::Send(_) => "R".to_owned(),
                Next::End => "-".to_owned(),
                Next::Wait => break,
            });
            if found.last().is_some_and(|last| last == "-") {
                break;
            }
        }
        found.join(" ")
    }

    #[test]
    fn sends_events_until_they_are_acknowledged() {
        let outbox = Outbox::default();
        outbox.report(Telemetry::default());
        outbox.report(Telemetry::default());
        for _ in 0..3 {
            outbox.send_event(event(EventKind::Note, "n"));
        }
        assert_eq!(written(&outbox), "1 2 3 R");
        outbox.acknowledged(1);
        // The connection is lost; the server has received event 2 but not acknowledged it.
        outbox.report(Telemetry::default());
        outbox.send_event(event(EventKind::Note, "during the outage"));
        outbox.resume(2);
        assert_eq!(written(&outbox), "3 4");
        // A restarted server has received nothing; acknowledged events are still not sent again.
        outbox.resume(0);
        assert_eq!(written(&outbox), "3 4");
        outbox.close();
        assert_eq!(written(&outbox), "", "4 is not acknowledged");
        outbox.acknowledged(4);
        assert_eq!(written(&outbox), "-");
    }

    #[test]
    fn sends_the_guards_limits_once_per_connection_and_on_change() {
        let outbox = Outbox::default();
        let arena = crate::flight::tests::arena();
        let guarded = |polygons| Guarded::of(&arena, polygons);
        let sent = || match outbox.lock().take() {
            Next::Send(ToServer::Guarded(guarded)) => Some(guarded.polygons),
            _ => None,
        };
        outbox.report_guarded(guarded(None));
        outbox.report_guarded(guarded(None));
        assert_eq!((sent(), sent()), (Some(None), None));
        outbox.report_guarded(guarded(Some(1)));
        outbox.report_guarded(guarded(Some(2)));
        assert_eq!((sent(), sent()), (Some(Some(2)), None));
        outbox.resume(0);
        assert_eq!((sent(), sent()), (Some(Some(2)), None));
    }

    #[test]
    fn sends_imu_readings_in_batches_and_keeps_the_newest() {
        let outbox = Outbox::default();
        let reading = |ns| ImuReading {
            stamp: ServerTime::from_ns(ns),
            accel_mps2: glam::DVec3::Z,
            gyro_radps: glam::DVec3::ZERO,
        };
        let next = || match outbox.lock().take() {
            Next::Send(ToServer::Imu(batch)) => {
                batch.iter().map(|reading| reading.stamp.as_ns()).collect::<Vec<_>>()
            }
            _ => Vec::new(),
        };
        outbox.imu(reading(1));
        assert!(next().is_empty());
        outbox.imu(reading(2));
        assert_eq!(next(), [1, 2]);
        (3..20).for_each(|ns| outbox.imu(reading(ns)));
        assert_eq!(next(), [12, 13, 14, 15, 16, 17, 18, 19]);
        assert!(next().is_empty());
    }

    #[test]
    fn drops_the_plugins_lines_before_other_events() {
        let outbox = Outbox::default();
        outbox.send_event(event(EventKind::EmergencyStop, "stop"));
        for _ in 0..Outbox::MAX_EVENTS + 10 {
            outbox.send_event(event(EventKind::PluginOutput, "line"));
        }
        let inner = outbox.lock();
        assert_eq!(inner.events.len(), Outbox::MAX_EVENTS);
        assert_eq!(inner.events[0].1.kind, EventKind::EmergencyStop);
        assert_eq!(inner.events[1].0, 13);
    }
}
