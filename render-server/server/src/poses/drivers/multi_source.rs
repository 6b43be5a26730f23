//! Several sources in parallel, each in its own thread.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result};
use vizflyt_arena::config::MAX_VEHICLES;

use super::source::{Measurement, PoseSource, SourceCounters};
use vizflyt_process::lock;

/// Measurements of one call of a source.
type Batch = heapless::Vec<Measurement, MAX_VEHICLES>;

/// Source that combines several sources, in order of arrival.
#[derive(Debug)]
pub(super) struct MultiSource {
    inbox: Receiver<Batch>,
    batch: Batch,
    shared: Vec<Arc<Shared>>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// Counters and warnings of a source's thread.
#[derive(Debug, Default)]
struct Shared {
    counters: Mutex<[SourceCounters; MAX_VEHICLES]>,
    warnings: Mutex<Vec<String>>,
}

impl MultiSource {
    /// Starts a thread per source.
    pub(super) fn start(sources: Vec<Box<dyn PoseSource>>) -> Result<Self> {
        let (sender, inbox) = sync_channel(WAITING);
        let stop = Arc::new(AtomicBool::new(false));
        let (mut shared, mut threads) = (Vec::new(), Vec::new());
        for (index, source) in sources.into_iter().enumerate() {
            let own = Arc::new(Shared::default());
            shared.push(own.clone());
            let (sender, stop) = (sender.clone(), stop.clone());
            threads.push(
                std::thread::Builder::new()
                    .name(format!("pose {index}"))
                    .spawn(move || forward(source, &sender, &own, &stop))
                    .context("cannot start a source's thread")?,
            );
        }
        Ok(Self { inbox, batch: Batch::new(), shared, stop, threads })
    }
}

/// Forwards the measurements of one source until `stop`.
fn forward(
    mut source: Box<dyn PoseSource>,
    sender: &SyncSender<Batch>,
    shared: &Shared,
    stop: &AtomicBool,
) {
    while !stop.load(Ordering::Relaxed) {
        let batch: Batch = source.receive(PATIENCE).iter().take(MAX_VEHICLES).copied().collect();
        let yielded = !batch.is_empty();
        // A full queue means that no batch was read for a second: old measurements are of no use, and newer
        // ones follow.
        if yielded && let Err(TrySendError::Disconnected(_)) = sender.try_send(batch) {
            return;
        }
        for (vehicle, counters) in lock(&shared.counters).iter_mut().enumerate() {
            *counters = source.counters(vehicle);
        }
        if let Some(warning) = source.next_warning() {
            lock(&shared.warnings).push(warning);
        }
    }
}

impl PoseSource for MultiSource {
    fn receive(&mut self, timeout: Duration) -> &[Measurement] {
        self.batch.clear();
        if let Ok(batch) = self.inbox.recv_timeout(timeout) {
            self.batch = batch;
        }
        &self.batch
    }

    fn next_warning(&mut self) -> Option<String> {
        self.shared.iter().find_map(|shared| {
            let mut warnings = lock(&shared.warnings);
            (!warnings.is_empty()).then(|| warnings.remove(0))
        })
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        let of =
            |shared: &Arc<Shared>| lock(&shared.counters).get(vehicle).copied().unwrap_or_default();
        self.shared.iter().map(of).fold(SourceCounters::default(), |sum, own| {
            let bad_packets = sum.bad_packets + own.bad_packets;
            SourceCounters { bad_packets, ..sum.and(own) }
        })
    }
}

impl Drop for MultiSource {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A thread that panicked has reported it on standard error.
            let _ = thread.join();
        }
    }
}

/// Capacity of the queue: a second of one source at 200 Hz.
const WAITING: usize = 256;
/// Maximum delay until a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use vizflyt_arena::pose::Resolution;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::ServerTime;

    /// Source that yields `left` measurements, then none.
    struct Counted {
        source: u8,
        left: u64,
        measured: Vec<Measurement>,
        warned: bool,
    }

    impl PoseSource for Counted {
        fn receive(&mut self, _timeout: Duration) -> &[Measurement] {
            self.measured.clear();
            if self.left > 0 {
                self.left -= 1;
                self.measured.push(Measurement {
                    vehicle: 0,
                    source: self.source,
                    stamp: ServerTime::ZERO,
                    arrival: ServerTime::ZERO,
                    world_from_body: Pose::new(DVec3::ZERO, DQuat::IDENTITY),
                    sigma: None,
                    is_origin: false,
                    resolution: Resolution::default(),
                });
            } else {
                std::thread::yield_now();
            }
            &self.measured
        }
        fn next_warning(&mut self) -> Option<String> {
            (!std::mem::replace(&mut self.warned, true)).then(|| format!("of {}", self.source))
        }
        fn counters(&self, _vehicle: usize) -> SourceCounters {
            SourceCounters { poses: 10 - self.left, bad_packets: 1, ..SourceCounters::default() }
        }
    }

    #[test]
    fn yields_all_measurements_with_their_source() {
        let source = |source| -> Box<dyn PoseSource> {
            Box::new(Counted { source, left: 10, measured: Vec::new(), warned: false })
        };
        let mut several = MultiSource::start(vec![source(0), source(1), source(2)]).unwrap();
        let mut counts = [0; 3];
        while counts != [10; 3] {
            for measured in several.receive(Duration::from_secs(1)) {
                counts[usize::from(measured.source)] += 1;
            }
        }
        while several.counters(0).poses < 30 {
            std::thread::yield_now();
        }
        assert_eq!((several.counters(0).poses, several.counters(0).bad_packets), (30, 3));
        let mut warnings: Vec<_> = std::iter::from_fn(|| several.next_warning()).collect();
        warnings.sort_unstable();
        assert_eq!(warnings, ["of 0", "of 1", "of 2"]);
    }
}
