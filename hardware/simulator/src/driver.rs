//! The one file with a clock: runs a [`Simulation`] in real time between sockets.
//!
//! Own thread, 400 ticks a second by sleeping to the next one (a tokio timer would be a
//! millisecond late). A machine too slow for real time loses simulated time instead of falling
//! ever further behind: see [`MAX_BEHIND`].

use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use vizflyt_protocol::mavlink::MAX_PACKET;

use crate::link::{Endpoint, Link, bind_udp};
use crate::simulation::{Simulation, TICK_HZ};

/// Time that is caught up after a pause. More is given up: a vehicle that lives through a second
/// in an instant would answer to setpoints of the past.
const MAX_BEHIND: Duration = Duration::from_millis(100);
/// Warnings of lost time come at most this often.
const WARN_EVERY: Duration = Duration::from_secs(5);

/// The sockets of a running simulation.
pub struct Driver {
    simulation: Simulation,
    link: Link,
    mocap: Option<(UdpSocket, SocketAddr)>,
    /// Simulated seconds per second.
    factor: f64,
}

impl Driver {
    /// Opens the sockets: MAVLink, and where mocap datagrams go, if anywhere.
    ///
    /// # Errors
    /// Fails if a socket cannot be opened.
    pub fn open(
        simulation: Simulation,
        mavlink: Endpoint,
        vicon: Option<SocketAddr>,
        factor: f64,
    ) -> anyhow::Result<Self> {
        let link = Link::open(mavlink).with_context(|| {
            format!("simulator: cannot open {mavlink}; is the port in use by another simulator?")
        })?;
        let mocap = match vicon {
            Some(target) => {
                let any = if target.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
                let socket =
                    bind_udp(any).context("simulator: cannot open a socket for the mocap")?;
                Some((socket, target))
            }
            None => None,
        };
        Ok(Self { simulation, link, mocap, factor })
    }

    /// Returns our address of the MAVLink link.
    ///
    /// # Errors
    /// Fails if the operating system does not say.
    pub fn mavlink_address(&self) -> anyhow::Result<SocketAddr> {
        self.link.local_address().context("simulator: the link has no address")
    }

    /// Runs until `stop` is set; returns the simulation for its report, and the time given up
    /// because the machine was too slow. [s]
    pub fn run(mut self, stop: &Arc<AtomicBool>) -> (Simulation, f64) {
        let tick = Duration::from_secs_f64(1.0 / (TICK_HZ as f64 * self.factor));
        let most_behind = MAX_BEHIND.max(tick * 2);
        let mut next = Instant::now();
        let mut lost = Duration::ZERO;
        let mut warned: Option<(Instant, Duration)> = None;
        while !stop.load(Ordering::Relaxed) {
            let (simulation, link) = (&mut self.simulation, &mut self.link);
            link.receive(|bytes| simulation.handle_mavlink(bytes));
            let now = Instant::now();
            let behind = now.saturating_duration_since(next);
            if behind > most_behind {
                let given_up = behind.saturating_sub(most_behind);
                lost += given_up;
                next += given_up;
                if warned.is_none_or(|(at, _)| at.elapsed() > WARN_EVERY) {
                    let since =
                        lost.saturating_sub(warned.map_or(Duration::ZERO, |(_, lost)| lost));
                    tracing::warn!(
                        "simulator: {:.0} ms of simulated time given up; the machine is too busy for real time",
                        since.as_secs_f64() * 1e3,
                    );
                    warned = Some((now, lost));
                }
            }
            while next <= now {
                self.simulation.tick();
                next += tick;
                self.send_mavlink();
            }
            self.send_mocap();
            std::thread::sleep(next.saturating_duration_since(Instant::now()));
        }
        (self.simulation, lost.as_secs_f64())
    }

    fn send_mavlink(&mut self) {
        let mut buffer = [0; MAX_PACKET];
        while let Some(packet) = self.simulation.poll_mavlink(&mut buffer) {
            self.link.send(packet);
        }
    }

    /// Sends the newest pose. After a pause the ones before it are history that nobody could tell
    /// from the present.
    fn send_mocap(&mut self) {
        let mut newest = None;
        while let Some(datagram) = self.simulation.poll_mocap() {
            newest = Some(datagram);
        }
        if let (Some(datagram), Some((socket, target))) = (newest, &self.mocap) {
            // Lost like any datagram if nobody listens.
            let _ = socket.send_to(&datagram, target);
        }
    }
}
