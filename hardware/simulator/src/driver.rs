//! The one file with a clock: runs a [`Simulation`] in real time between sockets.
//!
//! Own thread, 400 ticks a second by sleeping to the next one (a tokio timer would be a
//! millisecond late). A machine too slow for real time loses simulated time instead of falling
//! ever further behind: see [`MAX_BEHIND`].

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use vizflyt_protocol::mavlink::MAX_PACKET;

use crate::link::{Endpoint, Link};
use crate::mocap::feed::{Feed, FeedTarget};
use crate::simulation::{MAX_LINKS, Simulation, TICK_HZ};
use crate::truth_feed::TruthFeed;

/// Time that is caught up after a pause. More is given up: a vehicle that lives through a second
/// in an instant would answer to setpoints of the past.
const MAX_BEHIND: Duration = Duration::from_millis(100);
/// Warnings of lost time come at most this often.
const WARN_EVERY: Duration = Duration::from_secs(5);

/// The sockets of a running simulation.
pub struct Driver {
    simulation: Simulation,
    links: Vec<Link>,
    mocap: Vec<Feed>,
    truth: Vec<TruthFeed>,
    /// Simulated seconds per second.
    factor: f64,
}

impl Driver {
    /// Opens what MAVLink goes over, at most [`MAX_LINKS`] ways, and where mocap poses go, if
    /// anywhere. `factor` is simulated seconds per second.
    ///
    /// # Errors
    /// Fails if something cannot be opened, or there are too many links.
    pub fn open(
        simulation: Simulation,
        mavlink: &[Endpoint],
        mocap: &[FeedTarget],
        factor: f64,
    ) -> anyhow::Result<Self> {
        anyhow::ensure!(
            mavlink.len() <= MAX_LINKS,
            "simulator: {} MAVLink endpoints; give {MAX_LINKS} at most",
            mavlink.len()
        );
        let links = mavlink
            .iter()
            .map(|endpoint| {
                Link::open(endpoint).with_context(|| {
                    format!("simulator: cannot open {endpoint}; is it in use by another simulator?")
                })
            })
            .collect::<anyhow::Result<_>>()?;
        let mocap = mocap
            .iter()
            .map(|target| Feed::open(*target))
            .collect::<std::io::Result<_>>()
            .context("simulator: cannot open a socket for the mocap")?;
        Ok(Self { simulation, links, mocap, truth: Vec::new(), factor })
    }

    /// Also sends the true pose at every tick, for cameras that are simulated elsewhere.
    #[must_use]
    pub fn telling_truth(mut self, feeds: Vec<TruthFeed>) -> Self {
        self.truth = feeds;
        self
    }

    /// Returns our address of each mocap feed.
    ///
    /// # Errors
    /// If the operating system does not report it.
    pub fn mocap_addresses(&self) -> anyhow::Result<Vec<SocketAddr>> {
        self.mocap
            .iter()
            .map(|feed| feed.address().context("simulator: a feed has no address"))
            .collect()
    }

    /// Returns our address or path of each MAVLink link.
    ///
    /// # Errors
    /// Fails if the operating system does not report it.
    pub fn mavlink_addresses(&self) -> anyhow::Result<Vec<String>> {
        self.links
            .iter()
            .map(|link| link.address().context("simulator: the link has no address"))
            .collect()
    }

    /// Runs until `stop` is set; returns the simulation for its report, and the time given up
    /// because the machine was too slow. [s]
    pub fn run(mut self, stop: &Arc<AtomicBool>) -> (Simulation, f64) {
        let mut pacer = Pacer::new(Instant::now(), self.factor);
        let mut warned: Option<(Instant, Duration)> = None;
        while !stop.load(Ordering::Relaxed) {
            let simulation = &mut self.simulation;
            for (index, link) in self.links.iter_mut().enumerate() {
                link.receive(|bytes| simulation.handle_mavlink(index, bytes));
            }
            let ticks = pacer.due(Instant::now());
            for left in (0..ticks).rev() {
                self.simulation.tick();
                self.send_mavlink();
                for truth in &mut self.truth {
                    truth.send(pacer.at(left), &self.simulation.true_pose());
                }
            }
            self.send_mocap();
            let before = warned.map_or(Duration::ZERO, |(_, lost)| lost);
            if pacer.lost > before && warned.is_none_or(|(at, _)| at.elapsed() > WARN_EVERY) {
                tracing::warn!(
                    "simulator: gave up {:.0} ms of simulated time; this machine is too busy for real time",
                    pacer.lost.saturating_sub(before).as_secs_f64() * 1e3,
                );
                warned = Some((Instant::now(), pacer.lost));
            }
            std::thread::sleep(pacer.next.saturating_duration_since(Instant::now()));
        }
        (self.simulation, pacer.lost.as_secs_f64())
    }

    fn send_mavlink(&mut self) {
        let mut buffer = [0; MAX_PACKET];
        while let Some(packet) = self.simulation.poll_mavlink(&mut buffer) {
            for link in &mut self.links {
                link.send(packet);
            }
        }
    }

    /// Sends the newest pose. After a pause the ones before it are history that nobody could tell
    /// from the present.
    fn send_mocap(&mut self) {
        let mut newest = None;
        while let Some(sight) = self.simulation.poll_mocap() {
            newest = Some(sight);
        }
        let Some(sight) = newest else { return };
        for feed in &mut self.mocap {
            feed.send(self.simulation.object(), &sight, self.simulation.now());
        }
    }
}

/// Returns how many ticks are due, and gives up what cannot be caught up.
#[derive(Clone, Copy, Debug)]
struct Pacer {
    tick: Duration,
    most_behind: Duration,
    /// When the next tick is due.
    next: Instant,
    /// Given up since the start.
    lost: Duration,
}

impl Pacer {
    fn new(start: Instant, factor: f64) -> Self {
        let tick = Duration::from_secs_f64(1.0 / (TICK_HZ as f64 * factor));
        Self { tick, most_behind: MAX_BEHIND.max(tick * 2), next: start, lost: Duration::ZERO }
    }

    /// Returns for when the tick was due that `left` of those due are left behind.
    fn at(&self, left: u32) -> Instant {
        let back = self.tick * (left + 1);
        self.next.checked_sub(back).unwrap_or(self.next)
    }

    /// Returns the ticks due at `now` and counts them as done.
    fn due(&mut self, now: Instant) -> u32 {
        let given_up = now.saturating_duration_since(self.next).saturating_sub(self.most_behind);
        self.lost += given_up;
        self.next += given_up;
        let mut ticks = 0;
        while self.next <= now {
            self.next += self.tick;
            ticks += 1;
        }
        ticks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn on_time_nothing_is_lost_and_late_wake_ups_are_made_good() {
        let start = Instant::now();
        let mut pacer = Pacer::new(start, 1.0);
        // Wake-ups 1 to 30 ms late, as on a busy machine.
        let mut ticks = 0;
        let mut now = start;
        for i in 0..1000u32 {
            now += MS * (1 + i * 7 % 30);
            ticks += pacer.due(now);
        }
        let expected = (now - start).as_secs_f64() * TICK_HZ as f64;
        assert!((f64::from(ticks) - expected).abs() <= 1.0, "{ticks} of {expected}");
        assert_eq!(pacer.lost, Duration::ZERO);
    }

    #[test]
    fn a_long_pause_is_given_up_but_for_a_tenth_of_a_second() {
        let start = Instant::now();
        let mut pacer = Pacer::new(start, 1.0);
        assert_eq!(pacer.due(start), 1);
        let ticks = pacer.due(start + MS * 5000);
        assert!(ticks <= 41, "{ticks}");
        assert!(pacer.lost > MS * 4890 && pacer.lost <= MS * 4900, "{:?}", pacer.lost);
        assert_eq!(pacer.due(start + MS * 5010), 4);
    }

    #[test]
    fn the_factor_scales_time() {
        let start = Instant::now();
        for (factor, expected) in [(0.1, 4), (4.0, 160)] {
            let mut pacer = Pacer::new(start, factor);
            pacer.due(start);
            assert_eq!(pacer.due(start + MS * 100), expected);
        }
    }
}
