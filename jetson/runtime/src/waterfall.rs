//! Latency by stage: computes percentiles of each stage from the stamps of images.
//!
//! ```text
//! images ── Stamps (of the server, converted, and of the runtime) ──▶ answered() ── sent() ──▶
//!    histograms of the complete flight, and of each of the last seconds
//! ```
//! No clock is read: all times are arguments. Memory is 230 KB for any length of flight. For the definition
//! of the stages see [`vizflyt_protocol::messages::Stage`].

use vizflyt_protocol::histogram::Histogram;
use vizflyt_protocol::messages::{INTERVAL_EDGES_MS, Intervals, Stage, Stages, Waterfall};
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::time::HostTime;
use zerocopy::byteorder::little_endian::U64;

/// Ends of an image's stages, all on this computer's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamps {
    /// Index of the camera.
    pub camera: u8,
    /// Measurement of the pose.
    pub pose: HostTime,
    /// Start of rendering.
    pub render_start: HostTime,
    /// End of rendering.
    pub render_end: HostTime,
    /// End of encoding.
    pub encode_end: HostTime,
    /// First byte passed to the server's transport.
    pub send: HostTime,
    /// Arrival of the first byte.
    pub receive_first: HostTime,
    /// Arrival of the last byte.
    pub receive: HostTime,
    /// End of decoding.
    pub decode_end: HostTime,
    /// Error bound of the converted server stamps. [ns]
    pub clock_error_ns: u64,
}

/// Relation between the times of sending and arrival of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Causality {
    /// Arrival after sending.
    Kept,
    /// Arrival before sending, within the clocks' error bound.
    WithinBound,
    /// Arrival before sending, beyond the error bound.
    Broken,
}

impl Stamps {
    /// Makes the stamps of an image from the server's stamps, the measurement time `pose`, and `own`: arrival
    /// of first and last byte, and end of decoding. Sets the clock error to 0.
    pub fn of(
        header: &ImageHeader,
        trailer: &ImageTrailer,
        pose: HostTime,
        own: [HostTime; 3],
    ) -> Self {
        let [receive_first, receive, decode_end] = own;
        let mut last = pose;
        // Converts relative to the pose, which has the same clock offset. An unset stamp is 0: its stage then
        // adds nothing.
        let mut host = |stamp: U64| {
            if stamp.get() > 0 {
                let after_ns = stamp.get().wrapping_sub(header.pose_ns.get()).cast_signed();
                last = pose.plus_ns(after_ns);
            }
            last
        };
        Self {
            camera: header.camera,
            pose,
            render_start: host(header.render_start_ns),
            render_end: host(header.render_end_ns),
            encode_end: host(trailer.encode_end_ns),
            send: host(trailer.send_ns),
            receive_first,
            receive,
            decode_end,
            clock_error_ns: 0,
        }
    }

    fn causality(&self) -> Causality {
        let early_ns = self.send.as_ns().saturating_sub(self.receive_first.as_ns());
        match early_ns {
            0 => Causality::Kept,
            early_ns if early_ns <= self.clock_error_ns => Causality::WithinBound,
            _ => Causality::Broken,
        }
    }

    /// Returns the contribution of each stage up to the plugin, and the age at the plugin's start. [ms]
    fn stages(&self, plugin_start: HostTime, plugin_end: HostTime) -> (Stages<f64>, f64) {
        // A stage that ends before its predecessor (overlap, or clock error) adds nothing.
        let mut reached = self.pose;
        let mut until = |end: HostTime| {
            let added_ms = end.seconds_since(reached).max(0.0) * 1e3;
            reached = reached.max(end);
            added_ms
        };
        let stages = Stages {
            pose: until(self.render_start),
            render: until(self.render_end),
            encode: until(self.encode_end),
            send: until(self.receive_first),
            receive: until(self.receive),
            decode: until(self.decode_end),
            handover: until(plugin_start),
            plugin: until(plugin_end),
            setpoint: 0.0,
        };
        (stages, plugin_start.seconds_since(self.pose).max(0.0) * 1e3)
    }
}

/// Ages by stage. See the module.
#[derive(Debug, Default)]
pub struct Waterfalls {
    flight: Box<Rows>,
    /// Ring buffer of the last seconds, indexed by their number modulo [`RECENT_S`].
    recent: [Box<Second>; RECENT_S],
    /// Time of the plugin's last callback.
    last_start: Option<HostTime>,
}

/// Period covered by [`Waterfalls::recent`]. [s]
pub const RECENT_S: usize = 5;

#[derive(Debug, Default)]
struct Second {
    number: u64,
    rows: Rows,
}

#[derive(Clone, Debug, Default)]
struct Rows {
    stages: Stages<Histogram>,
    age: Histogram,
    total: Histogram,
    interval: Histogram,
    bins: [u32; INTERVAL_EDGES_MS.len() + 1],
    clamped: u64,
    out_of_bound: u64,
}

impl Waterfalls {
    /// Records that the plugin processed the images of one observation from `start` to `end`.
    pub fn answered(&mut self, images: &[Stamps], start: HostTime, end: HostTime) {
        let interval_ms = self.last_start.map(|last| start.seconds_since(last) * 1e3);
        self.last_start = Some(start);
        self.count(start, |rows| {
            if let Some(interval_ms) = interval_ms {
                rows.interval.add(interval_ms);
                rows.bins[Intervals::bin(interval_ms)] += 1;
            }
            for image in images {
                let (stages, age_ms) = image.stages(start, end);
                for stage in Stage::ALL {
                    if stage != Stage::Setpoint {
                        rows.stages[stage].add(stages[stage]);
                    }
                }
                rows.age.add(age_ms);
                match image.causality() {
                    Causality::Kept => {}
                    Causality::WithinBound => rows.clamped += 1,
                    Causality::Broken => rows.out_of_bound += 1,
                }
            }
        });
    }

    /// Records that the setpoint for these images was sent at `sent`, after the plugin had returned at `end`.
    pub fn sent(&mut self, images: &[Stamps], end: HostTime, sent: HostTime) {
        self.count(sent, |rows| {
            for image in images {
                rows.stages.setpoint.add(sent.seconds_since(end) * 1e3);
                rows.total.add(sent.seconds_since(image.pose) * 1e3);
            }
        });
    }

    /// Returns the statistics of the complete flight.
    pub fn flight(&self) -> (Waterfall, Intervals) {
        self.flight.report()
    }

    /// Returns the statistics of the last [`RECENT_S`] seconds before `now`.
    pub fn recent(&self, now: HostTime) -> (Waterfall, Intervals) {
        let this = number(now);
        let mut rows = Rows::default();
        for second in &self.recent {
            if this.saturating_sub(second.number) < RECENT_S as u64 {
                rows.merge(&second.rows);
            }
        }
        rows.report()
    }

    fn count(&mut self, at: HostTime, add: impl Fn(&mut Rows)) {
        add(&mut self.flight);
        let number = number(at);
        let second = &mut self.recent[(number % RECENT_S as u64) as usize];
        if second.number != number {
            **second = Second { number, rows: Rows::default() };
        }
        add(&mut second.rows);
    }
}

fn number(at: HostTime) -> u64 {
    at.as_ns() / 1_000_000_000
}

impl Rows {
    fn merge(&mut self, other: &Self) {
        for stage in Stage::ALL {
            self.stages[stage].merge(&other.stages[stage]);
        }
        self.age.merge(&other.age);
        self.total.merge(&other.total);
        self.interval.merge(&other.interval);
        for (mine, theirs) in self.bins.iter_mut().zip(other.bins) {
            *mine += theirs;
        }
        self.clamped += other.clamped;
        self.out_of_bound += other.out_of_bound;
    }

    fn report(&self) -> (Waterfall, Intervals) {
        let waterfall = Waterfall {
            images: self.age.count(),
            answered: self.total.count(),
            stages: Stages::from_fn(|stage| self.stages[stage].times()),
            age: self.age.times(),
            total: self.total.times(),
            clamped: self.clamped,
            out_of_bound: self.out_of_bound,
        };
        (waterfall, Intervals { times: self.interval.times(), bins: self.bins })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_protocol::time::ServerTime;

    fn us(us: u64) -> HostTime {
        HostTime::from_ns(1_000_000_000 + us * 1000)
    }

    /// Returns stamps with stages of 4, 8, 2, 0.5, 1 and 1.5 ms.
    fn stamps(pose_us: u64) -> Stamps {
        let at = |after_us| us(pose_us + after_us);
        Stamps {
            camera: 0,
            pose: at(0),
            render_start: at(4_000),
            render_end: at(12_000),
            encode_end: at(14_000),
            send: at(14_100),
            receive_first: at(14_500),
            receive: at(15_500),
            decode_end: at(17_000),
            clock_error_ns: 100_000,
        }
    }

    fn near(found: f32, expected: f32) {
        assert!((found / expected - 1.0).abs() < 0.017, "{found} for {expected}");
    }

    #[test]
    fn measures_each_stage() {
        let mut falls = Waterfalls::default();
        for n in 0..100 {
            let image = stamps(n * 20_000);
            let (start, end) = (image.pose.plus_ns(17_300_000), image.pose.plus_ns(20_300_000));
            falls.answered(&[image], start, end);
            falls.sent(&[image], end, end.plus_ns(200_000));
        }
        let (waterfall, intervals) = falls.flight();
        assert_eq!((waterfall.images, waterfall.answered), (100, 100));
        let expected = [4.0, 8.0, 2.0, 0.5, 1.0, 1.5, 0.3, 3.0, 0.2];
        for (stage, expected) in Stage::ALL.into_iter().zip(expected) {
            near(waterfall.stages[stage].p50, expected);
            near(waterfall.stages[stage].max, expected);
        }
        near(waterfall.age.p99, 17.3);
        near(waterfall.total.p99, 20.5);
        near(intervals.times.p50, 20.0);
        assert_eq!(intervals.bins.iter().sum::<u32>(), 99);
        assert_eq!(intervals.bins[Intervals::bin(20.0)], 99);
        assert_eq!((waterfall.clamped, waterfall.out_of_bound), (0, 0));
    }

    #[test]
    fn converts_server_stamps_relative_to_the_pose() {
        let k = Intrinsics::from_horizontal_fov(4, 3, 1.0);
        let stamp = ServerTime::from_ns(77_000);
        let mut header = ImageHeader::new(1, 3, stamp, &k, &Pose::IDENTITY, &Pose::IDENTITY);
        header.render_start_ns = 78_000.into();
        header.render_end_ns = 80_000.into();
        let trailer = ImageTrailer::new(0, ServerTime::ZERO, ServerTime::from_ns(85_000));
        let found = Stamps::of(&header, &trailer, us(100), [us(110), us(111), us(112)]);
        let host = |us_: u64| us(100 + us_);
        assert_eq!((found.camera, found.pose), (3, us(100)));
        assert_eq!([found.render_start, found.render_end], [host(1), host(3)]);
        assert_eq!(found.encode_end, host(3), "unset: equal to the previous stamp");
        assert_eq!([found.send, found.receive_first], [host(8), host(10)]);
    }

    #[test]
    fn reports_the_last_seconds_separately() {
        let mut falls = Waterfalls::default();
        for n in 0..1000 {
            // One in 20 ms for 20 s; the plugin is slower after 10 s.
            let image = stamps(n * 20_000);
            let start = image.pose.plus_ns(17_000_000);
            let end = start.plus_ns(if n < 500 { 1_000_000 } else { 9_000_000 });
            falls.answered(&[image], start, end);
        }
        let now = us(1000 * 20_000);
        near(falls.flight().0.stages.plugin.p50, 1.0);
        let (recent, intervals) = falls.recent(now);
        near(recent.stages.plugin.p50, 9.0);
        assert!((200..=250).contains(&recent.images), "{}", recent.images);
        assert_eq!(u64::from(intervals.bins.iter().sum::<u32>()), recent.images);
        assert_eq!(falls.recent(now.plus_seconds(10.0)).0, Waterfall::default());
    }

    #[test]
    fn clamps_and_counts_images_that_arrive_before_they_are_sent() {
        let mut falls = Waterfalls::default();
        let early = |ns: i64| Stamps { receive_first: us(14_100).plus_ns(-ns), ..stamps(0) };
        for image in [early(0), early(100_000), early(100_001), early(900_000_000)] {
            falls.answered(&[image], us(18_000), us(19_000));
        }
        let (waterfall, _) = falls.flight();
        assert_eq!((waterfall.clamped, waterfall.out_of_bound), (1, 2));
        assert!(waterfall.stages.send.p50 < 0.002, "the smallest reported value");
    }

    proptest! {
        /// For any stamps, the sum of the stages up to the handover is the age.
        #[test]
        fn sum_of_stages_is_the_age(mut times in prop::collection::vec(0u64..1_000_000, 10), shuffle in any::<bool>()) {
            if !shuffle {
                times.sort_unstable();
            }
            let latest = *times.iter().max().unwrap();
            let image = Stamps {
                camera: 0,
                pose: us(times[0]),
                render_start: us(times[1]),
                render_end: us(times[2]),
                encode_end: us(times[3]),
                send: us(times[4]),
                receive_first: us(times[5]),
                receive: us(times[6]),
                decode_end: us(times[7]),
                clock_error_ns: 0,
            };
            let (start, end) = (us(latest), us(latest + 500));
            let (stages, age_ms) = image.stages(start, end);
            let sum: f64 = Stage::ALL.into_iter().map(|stage| stages[stage]).sum();
            prop_assert!((sum - stages.plugin - age_ms).abs() < 1e-6);
            prop_assert!(Stage::ALL.into_iter().all(|stage| stages[stage] >= 0.0));
            prop_assert!((stages.plugin - 0.5).abs() < 1e-9);
        }
    }
}
