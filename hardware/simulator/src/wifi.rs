//! Model of a Wi-Fi bridge's radio link in one direction: delays or drops packets. Sans-IO, between the autopilot and
//! its sockets.
//!
//! - Batching: a bridge sends UART data when a batch is old or large enough.
//! - Latency: a constant, plus an exponentially distributed part for contention.
//! - Loss in bursts: Gilbert's two states (E. N. Gilbert, BSTJ 1960), updated per batch.
//!
//! Order is kept, as with one access point.

use std::collections::VecDeque;

use vizflyt_protocol::time::AutopilotTime;

use crate::noise::Noise;

/// Quality of the link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WifiConfig {
    pub seed: u64,
    /// Constant part of the latency [s].
    pub latency_s: f64,
    /// Mean of the variable part of the latency [s].
    pub jitter_s: f64,
    /// Share of lost batches, 0 to 1.
    pub loss: f64,
    /// Mean length of a burst of losses [batches].
    pub burst: f64,
    /// Minimum and maximum wait of a batch, uniformly distributed [s].
    pub batch_s: (f64, f64),
}

impl Default for WifiConfig {
    /// An ESP8266 next to its access point: 2 ms over the air, 1 ms of contention, 1 % of the batches lost in bursts of
    /// three, and batches of 2 to 5 ms like mavesp8266.
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

/// Maximum size of a batch: one Ethernet packet [bytes].
const BATCH_BYTES: usize = 1400;
/// Maximum data in transit [bytes]; more is dropped, as by a bridge with full memory.
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

/// Packet with the number of its MAVLink link.
type Packet = (usize, Vec<u8>);

impl Wifi {
    /// Returns one direction; `direction` distinguishes the noise of the two.
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

    /// Returns the number of lost packets.
    pub fn lost(&self) -> u64 {
        self.lost
    }

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

    /// Returns the next packet that has arrived, with the number of its MAVLink link.
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
        // Chosen so that the share of time in a burst equals the configured loss.
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

    /// Sends a numbered packet at every tick. Returns (tick sent, tick arrived).
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
    fn latency_loss_and_bursts_match_the_configuration() {
        let config = WifiConfig { loss: 0.1, burst: 4.0, ..Default::default() };
        let arrived = run(config, 200_000);
        let share = 1.0 - arrived.len() as f64 / 200_000.0;
        assert!((share - 0.1).abs() < 0.01, "{share}");
        let mut ages: Vec<u32> = arrived.iter().map(|(sent, at)| at - sent).collect();
        ages.sort_unstable();
        let median_ms = f64::from(ages[ages.len() / 2]) * 2.5;
        assert!((2.0..10.0).contains(&median_ms), "{median_ms}");
        // Gaps: a batch contains about two packets, a burst is four batches.
        let gaps: Vec<u32> =
            arrived.windows(2).map(|w| w[1].0 - w[0].0 - 1).filter(|&gap| gap > 0).collect();
        let mean = f64::from(gaps.iter().sum::<u32>()) / gaps.len() as f64;
        assert!((5.0..14.0).contains(&mean), "{mean}");
    }

    #[test]
    fn seeds_are_repeatable_and_a_dead_link_loses_everything() {
        let with = |seed| run(WifiConfig { seed, loss: 0.2, ..Default::default() }, 1000);
        assert_eq!(with(3), with(3));
        assert_ne!(with(3), with(4));
        assert!(run(WifiConfig { loss: 1.0, ..Default::default() }, 1000).is_empty());
    }

    proptest! {
        /// For any link: packets arrive whole, once, in order, and not before the latency.
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
