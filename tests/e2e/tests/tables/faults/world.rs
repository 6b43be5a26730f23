//! Virtual time: minutes pass in seconds, with nanosecond resolution, identical in every run.
//!
//! Tokio's paused clock jumps to the next timer when every task waits, but its timers have a resolution of one
//! millisecond, and a packet takes less. Therefore a conductor keeps the events in between. When every task waits
//! (tokio parks the thread), it advances the clock to the next timed event, or to the next whole millisecond, where
//! tokio's own timers continue.

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::{Instant, advance, sleep_until};

type TimedEvent = Box<dyn FnOnce() + Send>;

/// The clock and the planned events.
#[derive(Default)]
pub(crate) struct World {
    /// Events by time, then by order of planning.
    planned: Mutex<BTreeMap<(Instant, u64), TimedEvent>>,
    count: Mutex<u64>,
    sooner: Notify,
    idle: Notify,
    waits: AtomicBool,
}

impl World {
    /// Runs the future that `play` returns for a new world, to its end.
    pub(crate) fn run<F: Future>(play: impl FnOnce(Arc<World>) -> F) -> F::Output {
        let world = Arc::new(World::default());
        let parked = world.clone();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .start_paused(true)
            .on_thread_park(move || {
                if parked.waits.swap(false, Ordering::Relaxed) {
                    parked.idle.notify_one();
                }
            })
            .build()
            .unwrap();
        runtime.block_on(async {
            let start = Instant::now();
            // Stamps are encoded with variable length. Every run starts at a length that stays constant until two years
            // after the machine's start.
            let stamp_ns = vizflyt_server::clock::now().as_ns();
            let whole_ms = (stamp_ns.next_multiple_of(START_NS) - stamp_ns).div_ceil(1_000_000);
            advance(Duration::from_millis(whole_ms)).await;
            tokio::spawn(world.clone().conduct(start));
            play(world).await
        })
    }

    /// Plans an event at a time.
    pub(crate) fn plan(&self, at: Instant, what: impl FnOnce() + Send + 'static) {
        let mut planned = lock(&self.planned);
        let mut count = lock(&self.count);
        *count += 1;
        if planned.first_key_value().is_none_or(|((first, _), _)| at < *first) {
            self.sooner.notify_one();
        }
        planned.insert((at, *count), Box::new(what));
    }

    fn next(&self) -> Option<Instant> {
        lock(&self.planned).first_key_value().map(|((at, _), _)| *at)
    }

    async fn conduct(self: Arc<Self>, start: Instant) {
        loop {
            let now = Instant::now();
            loop {
                let mut planned = lock(&self.planned);
                let Some(first) = planned.first_entry().filter(|e| e.key().0 <= now) else { break };
                let what = first.remove();
                drop(planned);
                what();
            }
            let into_ms = Duration::from_nanos((now - start).subsec_nanos() as u64 % MS_NS);
            let next = self.next();
            let near = next.is_some_and(|at| at < now + MS);
            if near || !into_ms.is_zero() {
                self.waits.store(true, Ordering::Relaxed);
                self.idle.notified().await;
                // The next event may have changed while the other tasks came to rest.
                let boundary = now - into_ms + MS;
                advance(self.next().map_or(boundary, |at| at.min(boundary)) - now).await;
            } else if let Some(at) = next {
                let into = Duration::from_nanos((at - start).subsec_nanos() as u64 % MS_NS);
                tokio::select! {
                    biased;
                    () = self.sooner.notified() => {}
                    () = sleep_until(at - into) => {}
                }
            } else {
                self.sooner.notified().await;
            }
        }
    }
}

/// Locks a mutex; only a failing test can poison it.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap()
}

const MS: Duration = Duration::from_millis(1);
const MS_NS: u64 = 1_000_000;
/// 13 days: from here to 2^56 ns, stamps have 8 bytes as varints.
const START_NS: u64 = 1 << 50;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_happen_in_order_and_on_time_between_tokios_timers() {
        let log = Arc::new(Mutex::new(Vec::new()));
        let seen = log.clone();
        World::run(|world| async move {
            let start = Instant::now();
            let us = move |us| start + Duration::from_micros(us);
            for at in [250, 1_300, 1_250, 2_000, 70_000_777] {
                let (seen, world_too) = (seen.clone(), world.clone());
                world.plan(us(at), move || {
                    lock(&seen).push((Instant::now() - start).as_micros());
                    if at == 1_250 {
                        // Planned by another event, before all others.
                        let seen = seen.clone();
                        world_too.plan(us(1_260), move || lock(&seen).push(1_260));
                    }
                });
            }
            tokio::time::sleep(Duration::from_millis(2)).await;
            assert_eq!(Instant::now() - start, Duration::from_millis(2), "timers keep their time");
            tokio::time::sleep(Duration::from_secs(100)).await;
            assert_eq!(Instant::now() - start, Duration::from_millis(100_002));
        });
        assert_eq!(*lock(&log), [250, 1_250, 1_260, 1_300, 2_000, 70_000_777]);
    }
}
