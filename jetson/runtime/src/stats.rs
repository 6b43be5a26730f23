//! Ages and times of images: for the flight in a histogram, for the last second exactly.

use std::collections::VecDeque;

use vizflyt_protocol::messages::ImageStats;
use vizflyt_protocol::time::HostTime;

/// Quantiles of durations at a resolution of 0.1 ms, in 80 KB however long the flight.
#[derive(Clone, Debug)]
pub struct Histogram {
    bins: Vec<u64>,
    count: u64,
}

const BIN_MS: f64 = 0.1;
/// Two seconds; longer ones count as that.
const BINS: usize = 20_000;

impl Default for Histogram {
    fn default() -> Self {
        Self { bins: vec![0; BINS], count: 0 }
    }
}

impl Histogram {
    /// Takes one duration. [ms]
    pub fn add(&mut self, ms: f64) {
        let bin = (ms / BIN_MS).clamp(0.0, (BINS - 1) as f64) as usize;
        self.bins[bin] += 1;
        self.count += 1;
    }

    /// Returns the duration that a share `q` of all stay below; 0 if there is none. [ms]
    pub fn quantile_ms(&self, q: f64) -> f64 {
        let rank = (q * self.count as f64).ceil().max(1.0) as u64;
        let mut seen = 0;
        for (bin, &count) in self.bins.iter().enumerate() {
            seen += count;
            if seen >= rank {
                return (bin as f64 + 0.5) * BIN_MS;
            }
        }
        0.0
    }
}

/// One answered image.
#[derive(Clone, Copy, Debug)]
struct Answered {
    at: HostTime,
    age_ms: f32,
    plugin_ms: f32,
}

/// How images fare between pose and plugin.
#[derive(Debug, Default)]
pub struct ImageTimes {
    /// Published and not answered: number, stamp of the pose it shows.
    pending: VecDeque<(u64, HostTime)>,
    recent: VecDeque<Answered>,
    ages: Histogram,
    plugin: Histogram,
    delivered: u64,
    first_at: Option<HostTime>,
    last_at: Option<HostTime>,
}

/// Images published and unanswered that are remembered; a plugin has one at a time, so more are
/// skipped ones.
const PENDING: usize = 256;

impl ImageTimes {
    /// Takes note of image `seq`, which shows the pose of `pose`.
    pub fn published(&mut self, seq: u64, pose: HostTime) {
        if self.pending.len() == PENDING {
            self.pending.pop_front();
        }
        self.pending.push_back((seq, pose));
    }

    /// Takes note of the plugin's answer; returns the image's age when the plugin got it. [ms]
    pub fn answered(&mut self, seq: u64, entered: HostTime, returned: HostTime) -> Option<f64> {
        while self.pending.front().is_some_and(|&(older, _)| older < seq) {
            self.pending.pop_front();
        }
        let (_, pose) = self.pending.pop_front_if(|(found, _)| *found == seq)?;
        let age_ms = entered.seconds_since(pose) * 1e3;
        let plugin_ms = returned.seconds_since(entered) * 1e3;
        self.ages.add(age_ms);
        self.plugin.add(plugin_ms);
        self.delivered += 1;
        self.first_at.get_or_insert(entered);
        self.last_at = Some(entered);
        self.recent.push_back(Answered {
            at: entered,
            age_ms: age_ms as f32,
            plugin_ms: plugin_ms as f32,
        });
        Some(age_ms)
    }

    /// Returns the figures of the last second before `now`; `replaced` images were replaced by
    /// newer ones before they reached shared memory.
    pub fn last_second(&mut self, now: HostTime, published: u64, replaced: u64) -> ImageStats {
        while self.recent.front().is_some_and(|image| now.seconds_since(image.at) > 1.0) {
            self.recent.pop_front();
        }
        let quantile = |q: f64, of: fn(&Answered) -> f32| {
            let mut values: Vec<f32> = self.recent.iter().map(of).collect();
            values.sort_by(f32::total_cmp);
            let rank = (q * values.len() as f64).ceil() as usize;
            values.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
        };
        ImageStats {
            delivered: self.delivered,
            skipped: published.saturating_sub(self.delivered) + replaced,
            rate_hz: self.recent.len() as f32,
            age_ms_p50: quantile(0.5, |image| image.age_ms),
            age_ms_p99: quantile(0.99, |image| image.age_ms),
            plugin_ms_p50: quantile(0.5, |image| image.plugin_ms),
        }
    }

    /// Returns images that reached the plugin.
    pub fn delivered(&self) -> u64 {
        self.delivered
    }

    /// Returns images that reached the plugin per second, from the first to the last. [Hz]
    pub fn rate_hz(&self) -> f64 {
        match (self.first_at, self.last_at) {
            (Some(first), Some(last)) if last > first => {
                (self.delivered - 1) as f64 / last.seconds_since(first)
            }
            _ => 0.0,
        }
    }

    /// Returns ages at the plugin's callback.
    pub fn ages(&self) -> &Histogram {
        &self.ages
    }

    /// Returns times inside the plugin.
    pub fn plugin(&self) -> &Histogram {
        &self.plugin
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> HostTime {
        HostTime::from_ns(ms * 1_000_000)
    }

    #[test]
    fn quantiles_are_within_a_bin() {
        let mut histogram = Histogram::default();
        assert_eq!(histogram.quantile_ms(0.5), 0.0);
        for n in 1..=1000 {
            histogram.add(f64::from(n) * 0.1);
        }
        assert!((histogram.quantile_ms(0.5) - 50.0).abs() <= 0.1);
        assert!((histogram.quantile_ms(0.99) - 99.0).abs() <= 0.1);
        histogram.add(f64::MAX);
        histogram.add(-1.0);
        assert!(histogram.quantile_ms(1.0) <= 2000.0);
    }

    #[test]
    fn ages_belong_to_the_image_answered() {
        let mut times = ImageTimes::default();
        for seq in 0..5 {
            times.published(seq, ms(1000 + 20 * seq));
        }
        // 0 to 2 were skipped.
        assert_eq!(times.answered(3, ms(1070), ms(1075)), Some(10.0));
        assert_eq!(times.answered(3, ms(1070), ms(1075)), None, "answered twice");
        assert_eq!(times.answered(4, ms(1080), ms(1081)), Some(0.0));
        assert_eq!(times.answered(99, ms(1080), ms(1081)), None, "never published");
        let stats = times.last_second(ms(1100), 5, 7);
        assert_eq!((stats.delivered, stats.skipped), (2, 10));
        assert_eq!((stats.rate_hz, stats.age_ms_p99, stats.plugin_ms_p50), (2.0, 10.0, 1.0));
        assert_eq!(times.last_second(ms(9000), 5, 7).rate_hz, 0.0);
        assert_eq!(times.rate_hz(), 100.0);
    }
}
