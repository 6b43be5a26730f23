//! Runs a [`Simulation`] in real time between sockets. Only this file has a clock.
//!
//! A separate thread runs 400 ticks a second and sleeps between them (a tokio timer would be a millisecond late). If
//! the machine is too slow for real time, simulated time is dropped instead of accumulating delay: see [`MAX_BEHIND`].

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

/// Maximum delay that is caught up. More is dropped: a vehicle that simulates a second in an instant would respond to
/// outdated setpoints.
const MAX_BEHIND: Duration = Duration::from_millis(100);
/// Minimum interval between warnings of lost time.
const WARN_EVERY: Duration = Duration::from_secs(5);

/// Running simulation with its sockets.
pub struct Driver {
    simulation: Simulation,
    links: Vec<Link>,
    mocap: Vec<Feed>,
    truth: Vec<TruthFeed>,
    /// Simulated seconds per second.
    factor: f64,
}

impl Driver {
    /// Opens at most [`MAX_LINKS`] MAVLink links and the sockets of the mocap feeds. `factor` is simulated seconds per
    /// second.
    ///
    /// # Errors
    /// Fails if a link or socket cannot be opened, or if there are too many links.
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

    /// Also sends the true pose at every tick, for simulated cameras of other programs.
    #[must_use]
    pub fn telling_truth(mut self, feeds: Vec<TruthFeed>) -> Self {
        self.truth = feeds;
        self
    }

    /// Returns the local address of each mocap feed.
    ///
    /// # Errors
    /// If the operating system does not report it.
    pub fn mocap_addresses(&self) -> anyhow::Result<Vec<SocketAddr>> {
        self.mocap
            .iter()
            .map(|feed| feed.address().context("simulator: a feed has no address"))
            .collect()
    }

    /// Returns the local address or path of each MAVLink link.
    ///
    /// # Errors
    /// Fails if the operating system does not report it.
    pub fn mavlink_addresses(&self) -> anyhow::Result<Vec<String>> {
        self.links
            .iter()
            .map(|link| link.address().context("simulator: the link has no address"))
            .collect()
    }

    /// Runs until `stop` is set. Returns the simulation for its report, and the simulated time that was dropped [s].
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

    /// Sends only the newest pose. After a pause, older poses would be indistinguishable from current ones.
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

/// Computes the number of due ticks, and drops time that cannot be caught up.
#[derive(Clone, Copy, Debug)]
struct Pacer {
    tick: Duration,
    most_behind: Duration,
    /// Time of the next tick.
    next: Instant,
    /// Dropped time since the start.
    lost: Duration,
}

impl Pacer {
    fn new(start: Instant, factor: f64) -> Self {
        let tick = Duration::from_secs_f64(1.0 / (TICK_HZ as f64 * factor));
        Self { tick, most_behind: MAX_BEHIND.max(tick * 2), next: start, lost: Duration::ZERO }
    }

    /// Returns the due time of the tick after which `left` due ticks remain.
    fn at(&self, left: u32) -> Instant {
        let back = self.tick * (left + 1);
        self.next.checked_sub(back).unwrap_or(self.next)
    }

    /// Returns the number of ticks due at `now`, and counts them as done.
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
    fn catches_up_after_late_wake_ups_without_loss() {
        let start = Instant::now();
        let mut pacer = Pacer::new(start, 1.0);
        // Wake-ups that are 1 to 30 ms late, as on a busy machine.
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
    fn drops_a_long_pause_except_a_tenth_of_a_second() {
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
