//! Statistics of images from the pose to the plugin: ages, rates, and outcome of each.

use std::collections::VecDeque;

use heapless::Vec as Bounded;
use vizflyt_protocol::histogram::Histogram;
use vizflyt_protocol::messages::{
    Arrivals, ClockState, ImageStats, Intervals, MAX_CAMERAS, Timing, Waterfall,
};
use vizflyt_protocol::time::HostTime;

use crate::waterfall::{RECENT_S, Stamps, Waterfalls};

/// Images of one observation.
type Images = Bounded<Stamps, MAX_CAMERAS>;

/// One image with a reply.
#[derive(Clone, Copy, Debug)]
struct AnsweredImage {
    at: HostTime,
    age_ms: f32,
    plugin_ms: f32,
}

/// A published observation without a reply.
#[derive(Debug)]
struct Pending {
    seq: u64,
    /// Stamp of the pose that it shows.
    pose: HostTime,
    /// Time from which on the plugin could take it.
    ready: HostTime,
    images: Images,
}

/// A reply with an unsent setpoint.
#[derive(Debug)]
struct Unsent {
    seq: u64,
    returned: HostTime,
    images: Images,
}

/// Statistics of images. See the module.
#[derive(Debug, Default)]
pub struct ImageTimes {
    pending: VecDeque<Pending>,
    unsent: Option<Unsent>,
    recent: VecDeque<AnsweredImage>,
    waterfalls: Waterfalls,
    ages: Histogram,
    plugin: Histogram,
    delivered: u64,
    /// Counts of delivered and skipped images, by camera.
    cameras: [Arrivals; MAX_CAMERAS],
    /// Time of the plugin's last return.
    returned_at: HostTime,
    first_at: Option<HostTime>,
    last_at: Option<HostTime>,
}

/// Maximum number of stored observations without a reply. A plugin processes one at a time, so the others
/// are skipped ones.
const PENDING: usize = 256;

impl ImageTimes {
    /// Records the publication of observation `seq`, with the pose stamp `pose`, at `ready`.
    pub fn published(&mut self, seq: u64, pose: HostTime, ready: HostTime, images: Images) {
        if self.pending.len() == PENDING {
            self.skip_first();
        }
        self.pending.push_back(Pending { seq, pose, ready, images });
    }

    /// Counts the oldest pending observation as skipped.
    fn skip_first(&mut self) {
        let Some(skipped) = self.pending.pop_front() else { return };
        // Whether the plugin was still busy with an earlier observation when this one was ready.
        let was_busy = skipped.ready < self.returned_at || self.pending.len() + 1 >= PENDING;
        for image in &skipped.images {
            let camera = &mut self.cameras[usize::from(image.camera) % MAX_CAMERAS];
            if was_busy {
                camera.overrun += 1;
            } else {
                camera.unasked += 1;
            }
        }
    }

    /// Records the plugin's reply; returns the image's age at the plugin's callback. [ms]
    pub fn answered(&mut self, seq: u64, entered: HostTime, returned: HostTime) -> Option<f64> {
        while self.pending.front().is_some_and(|older| older.seq < seq) {
            self.skip_first();
        }
        let Pending { pose, images, .. } = self.pending.pop_front_if(|found| found.seq == seq)?;
        let age_ms = entered.seconds_since(pose) * 1e3;
        let plugin_ms = returned.seconds_since(entered) * 1e3;
        self.ages.add(age_ms);
        self.plugin.add(plugin_ms);
        self.delivered += 1;
        for image in &images {
            self.cameras[usize::from(image.camera) % MAX_CAMERAS].delivered += 1;
        }
        self.waterfalls.answered(&images, entered, returned);
        self.unsent = Some(Unsent { seq, returned, images });
        self.returned_at = returned;
        self.first_at.get_or_insert(entered);
        self.last_at = Some(entered);
        self.recent.push_back(AnsweredImage {
            at: entered,
            age_ms: age_ms as f32,
            plugin_ms: plugin_ms as f32,
        });
        Some(age_ms)
    }

    /// Records that a setpoint with the reply to observation `seq` was sent at `sent`; only the first one
    /// counts.
    pub fn sent(&mut self, seq: u64, sent: HostTime) {
        if let Some(unsent) = self.unsent.take_if(|unsent| unsent.seq == seq) {
            self.waterfalls.sent(&unsent.images, unsent.returned, sent);
        }
    }

    /// Returns the statistics of the last second before `now`. `replaced`: number of images that were
    /// replaced by newer ones before they reached shared memory.
    pub fn last_second(&mut self, now: HostTime, published: u64, replaced: u64) -> ImageStats {
        while self.recent.front().is_some_and(|image| now.seconds_since(image.at) > 1.0) {
            self.recent.pop_front();
        }
        let quantile = |q: f64, of: fn(&AnsweredImage) -> f32| {
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

    /// Returns the periodic latency report at `now`. `arrived`: counts of images before shared memory, by
    /// camera.
    pub fn timing(&self, now: HostTime, clock: Option<ClockState>, arrived: &[Arrivals]) -> Timing {
        let (waterfall, intervals) = self.waterfalls.recent(now);
        let cameras = self.arrivals(arrived);
        Timing { seconds: RECENT_S as f32, waterfall, intervals, clock, cameras }
    }

    /// Returns the latency report of the complete flight; see [`Self::timing`].
    pub fn whole(&self, now: HostTime, clock: Option<ClockState>, arrived: &[Arrivals]) -> Timing {
        let (waterfall, intervals) = self.waterfalls.flight();
        let seconds = self.first_at.map_or(0.0, |first| now.seconds_since(first)) as f32;
        Timing { seconds, waterfall, intervals, clock, cameras: self.arrivals(arrived) }
    }

    /// Returns the counts of images by camera: `before` for those before shared memory, completed by the
    /// counts of this struct.
    pub fn arrivals(&self, before: &[Arrivals]) -> Bounded<Arrivals, MAX_CAMERAS> {
        let join = |(before, own): (&Arrivals, &Arrivals)| Arrivals {
            delivered: own.delivered,
            unasked: own.unasked,
            overrun: own.overrun,
            ..*before
        };
        before.iter().zip(&self.cameras).map(join).collect()
    }

    /// Returns the ages and intervals of the complete flight.
    pub fn flight(&self) -> (Waterfall, Intervals) {
        self.waterfalls.flight()
    }

    /// Returns the number of images that reached the plugin.
    pub fn delivered(&self) -> u64 {
        self.delivered
    }

    /// Returns the rate of images that reached the plugin, from the first to the last. [Hz]
    pub fn rate_hz(&self) -> f64 {
        match (self.first_at, self.last_at) {
            (Some(first), Some(last)) if last > first => {
                (self.delivered - 1) as f64 / last.seconds_since(first)
            }
            _ => 0.0,
        }
    }

    /// Returns the ages at the plugin's callback.
    pub fn ages(&self) -> &Histogram {
        &self.ages
    }

    /// Returns the times inside the plugin.
    pub fn plugin(&self) -> &Histogram {
        &self.plugin
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ms(ms: u64) -> HostTime {
        HostTime::from_ns(ms * 1_000_000)
    }

    /// Returns images of these cameras, decoded at `ready`.
    fn images(cameras: &[u8], pose: HostTime, ready: HostTime) -> Images {
        let stamps = |&camera| Stamps {
            camera,
            pose,
            render_start: pose,
            render_end: pose,
            encode_end: pose,
            send: pose,
            receive_first: ready,
            receive: ready,
            decode_end: ready,
            clock_error_ns: 0,
        };
        cameras.iter().map(stamps).collect()
    }

    #[test]
    fn assigns_ages_to_the_replied_image() {
        let mut times = ImageTimes::default();
        for seq in 0..5 {
            let pose = ms(1000 + 20 * seq);
            times.published(seq, pose, pose.plus_seconds(0.01), images(&[0], pose, pose));
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

    #[test]
    fn distinguishes_images_skipped_by_a_busy_and_by_an_idle_plugin() {
        let mut times = ImageTimes::default();
        let publish = |times: &mut ImageTimes, seq, ready| {
            times.published(
                seq,
                ms(ready - 10),
                ms(ready),
                images(&[0, 2], ms(ready - 10), ms(ready)),
            );
        };
        publish(&mut times, 1, 100);
        times.answered(1, ms(100), ms(150));
        // 2 is ready while the plugin is busy with 1; 3 is ready afterwards, but replaced by 4 before it is taken.
        publish(&mut times, 2, 120);
        publish(&mut times, 3, 151);
        publish(&mut times, 4, 152);
        times.answered(4, ms(153), ms(154));
        let arrived = [Arrivals { arrived: 4, ..Arrivals::default() }; 3];
        let found = times.arrivals(&arrived);
        let expected =
            Arrivals { arrived: 4, delivered: 2, overrun: 1, unasked: 1, ..Arrivals::default() };
        assert_eq!((found[0], found[2]), (expected, expected));
        assert_eq!(found[0].ended(), 4);
        assert_eq!(found[1], arrived[1], "no images of camera 1");
    }

    #[test]
    fn counts_only_the_first_setpoint_of_a_reply() {
        let mut times = ImageTimes::default();
        times.published(1, ms(100), ms(110), images(&[0], ms(100), ms(110)));
        times.sent(1, ms(111));
        times.answered(1, ms(112), ms(115));
        times.sent(7, ms(116));
        times.sent(1, ms(118));
        times.sent(1, ms(138));
        let (waterfall, _) = times.flight();
        assert_eq!((waterfall.images, waterfall.answered), (1, 1));
        assert!((waterfall.total.max - 18.0).abs() < 1e-3);
        assert!((waterfall.stages.setpoint.max - 3.0).abs() < 1e-3);
    }

    proptest! {
        /// Each published image is counted once, for any behaviour of the plugin.
        #[test]
        fn counts_each_image_once(script in prop::collection::vec((0u64..30, any::<bool>()), 1..600)) {
            let mut times = ImageTimes::default();
            let (mut now, mut seq, mut published) = (1000, 0, 0u64);
            for (pause, answers) in script {
                now += pause;
                seq += 1;
                published += 1;
                times.published(seq, ms(now), ms(now), images(&[1], ms(now), ms(now)));
                if answers {
                    times.answered(seq, ms(now), ms(now + pause));
                }
            }
            let found = times.arrivals(&[Arrivals { arrived: published, ..Arrivals::default() }; 2]);
            prop_assert_eq!(found[1].ended() + times.pending.len() as u64, published);
            prop_assert_eq!(found[1].delivered, times.delivered());
        }
    }
}
