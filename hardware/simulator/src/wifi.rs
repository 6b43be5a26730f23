//! The radio link of a Wi-Fi bridge, both ways: packets in, packets out later, or never. Sans-IO, a
//! decorator between the autopilot and whatever carries its bytes.
//!
//! - Batching: a bridge sends what its UART brought when a batch has grown old enough or full.
//! - Latency: a constant, and what contention for the air adds, exponentially distributed.
//! - Loss in bursts: Gilbert's two states (E. N. Gilbert, BSTJ 1960), entered per batch.
//!
//! Order is kept, as one access point keeps it.

use std::collections::VecDeque;

use vizflyt_protocol::time::AutopilotTime;

use crate::noise::Noise;

/// How good the link is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WifiConfig {
    /// Seed of latency and loss.
    pub seed: u64,
    /// Constant part of the latency. [s]
    pub latency_s: f64,
    /// Mean of what is added to it. [s]
    pub jitter_s: f64,
    /// Share of batches lost, 0 to 1.
    pub loss: f64,
    /// Mean length of a burst of losses. [batches]
    pub burst: f64,
    /// A batch waits at least and at most this long, uniformly. [s]
    pub batch_s: (f64, f64),
}

impl Default for WifiConfig {
    /// An ESP8266 next to its access point: 2 ms over the air and 1 ms of contention, 1 % of the
    /// batches lost, three in a row, batches of 2 to 5 ms as mavesp8266 makes them.
    fn default() -> Self {
        Self {
            seed: 0,
            latency_s: 0.002,
            jitter_s: 0.001,
            loss: 0.01,
            burst: 3.0,
            batch_s: (0.002, 0.005),
        }
    }
}

/// Largest batch: what fits one Ethernet packet. [bytes]
const BATCH_BYTES: usize = 1400;
/// Bytes under way at most; beyond it the newest are dropped, as by a bridge without memory. [bytes]
const MAX_QUEUED: usize = 32 * 1024;

/// One direction of the link.
#[derive(Clone, Debug)]
pub struct Wifi {
    config: WifiConfig,
    noise: Noise,
    in_burst: bool,
    batch: Vec<Packet>,
    batch_bytes: usize,
    batch_ends: AutopilotTime,
    flying: VecDeque<(AutopilotTime, Packet)>,
    queued: usize,
    last_arrival: AutopilotTime,
    lost: u64,
}

/// A packet, and which link it came by.
type Packet = (usize, Vec<u8>);

impl Wifi {
    /// Makes one direction; `direction` distinguishes the two.
    pub fn new(config: WifiConfig, direction: u64) -> Self {
        Self {
            config,
            noise: Noise::new(config.seed, 16 + direction),
            in_burst: false,
            batch: Vec::new(),
            batch_bytes: 0,
            batch_ends: AutopilotTime::ZERO,
            flying: VecDeque::new(),
            queued: 0,
            last_arrival: AutopilotTime::ZERO,
            lost: 0,
        }
    }

    /// Returns packets lost.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Takes a packet.
    pub fn send(&mut self, now: AutopilotTime, link: usize, packet: &[u8]) {
        if self.queued + packet.len() > MAX_QUEUED {
            self.lost += 1;
            return;
        }
        if self.batch_bytes + packet.len() > BATCH_BYTES {
            self.close_batch(now);
        }
        if self.batch.is_empty() {
            let (least_s, most_s) = self.config.batch_s;
            let wait_s = least_s + (most_s - least_s) * self.noise.uniform();
            self.batch_ends = now.plus_seconds(wait_s);
        }
        self.batch.push((link, packet.to_vec()));
        self.batch_bytes += packet.len();
        self.queued += packet.len();
    }

    /// Returns the next packet that has arrived, and which link it came by.
    pub fn poll(&mut self, now: AutopilotTime) -> Option<(usize, Vec<u8>)> {
        if !self.batch.is_empty() && now >= self.batch_ends {
            self.close_batch(now);
        }
        let (_, (link, packet)) = self.flying.pop_front_if(|(at, _)| *at <= now)?;
        self.queued -= packet.len();
        Some((link, packet))
    }

    fn close_batch(&mut self, now: AutopilotTime) {
        let batch = std::mem::take(&mut self.batch);
        self.batch_bytes = 0;
        if self.is_lost() {
            self.lost += batch.len() as u64;
            self.queued -= batch.iter().map(|(_, packet)| packet.len()).sum::<usize>();
            return;
        }
        let wait_s = -self.config.jitter_s * (1.0 - self.noise.uniform()).ln();
        let arrival = now.plus_seconds(self.config.latency_s + wait_s).max(self.last_arrival);
        self.last_arrival = arrival;
        self.flying.extend(batch.into_iter().map(|packet| (arrival, packet)));
    }

    fn is_lost(&mut self) -> bool {
        let draw = self.noise.uniform();
        let leave = 1.0 / self.config.burst.max(1.0);
        if self.config.loss >= 1.0 {
            return true;
        }
        // So that the share of time in a burst is the loss asked for.
        let enter = leave * self.config.loss / (1.0 - self.config.loss);
        self.in_burst = if self.in_burst { draw >= leave } else { draw < enter };
        self.in_burst
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TICK_NS: u64 = 2_500_000;

    /// Sends a numbered packet a tick; returns (tick sent, tick arrived).
    fn run(config: WifiConfig, ticks: u32) -> Vec<(u32, u32)> {
        let mut wifi = Wifi::new(config, 0);
        let mut arrived = Vec::new();
        for tick in 0..ticks {
            let now = AutopilotTime::from_ns(u64::from(tick) * TICK_NS);
            wifi.send(now, 1, &tick.to_le_bytes());
            while let Some((link, packet)) = wifi.poll(now) {
                assert_eq!(link, 1);
                arrived.push((u32::from_le_bytes(packet.try_into().unwrap()), tick));
            }
        }
        arrived
    }

    #[test]
    fn latency_loss_and_bursts_are_as_asked_for() {
        let config = WifiConfig { loss: 0.1, burst: 4.0, ..Default::default() };
        let arrived = run(config, 200_000);
        let share = 1.0 - arrived.len() as f64 / 200_000.0;
        assert!((share - 0.1).abs() < 0.01, "{share}");
        let mut ages: Vec<u32> = arrived.iter().map(|(sent, at)| at - sent).collect();
        ages.sort_unstable();
        let median_ms = f64::from(ages[ages.len() / 2]) * 2.5;
        assert!((2.0..10.0).contains(&median_ms), "{median_ms}");
        // Gaps: a batch holds about two packets, a burst is four batches.
        let gaps: Vec<u32> =
            arrived.windows(2).map(|w| w[1].0 - w[0].0 - 1).filter(|&gap| gap > 0).collect();
        let mean = f64::from(gaps.iter().sum::<u32>()) / gaps.len() as f64;
        assert!((5.0..14.0).contains(&mean), "{mean}");
    }

    #[test]
    fn a_seed_repeats_and_nothing_comes_through_a_dead_link() {
        let with = |seed| run(WifiConfig { seed, loss: 0.2, ..Default::default() }, 1000);
        assert_eq!(with(3), with(3));
        assert_ne!(with(3), with(4));
        assert!(run(WifiConfig { loss: 1.0, ..Default::default() }, 1000).is_empty());
    }

    proptest! {
        /// Whatever the link: packets come whole, once, in order, and no sooner than its latency.
        #[test]
        fn packets_arrive_unchanged_and_in_order(
            seed in 0..1000u64, latency_ms in 0.0..50.0f64, jitter_ms in 0.0..20.0f64, loss in 0.0..=1.0f64,
        ) {
            let config = WifiConfig {
                seed,
                latency_s: latency_ms / 1e3,
                jitter_s: jitter_ms / 1e3,
                loss,
                ..Default::default()
            };
            let arrived = run(config, 500);
            prop_assert!(arrived.windows(2).all(|w| w[0].0 < w[1].0));
            prop_assert!(arrived.iter().all(|(sent, at)| f64::from(at - sent) * 2.5 >= latency_ms));
        }
    }
}
