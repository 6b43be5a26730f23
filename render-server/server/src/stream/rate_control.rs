//! Rate control for slow links: reduces quality before rate, and rate before resolution.
//!
//! ```text
//! every finished image (bytes, handed, acknowledged or dropped) -> capacity of the link
//! four times a second: load of each level                          -> level
//! level -> encoder's options, frame decimation, size
//! ```
//! Pure: no clock, no socket. There is one [`RateController`] per session, because all cameras of a vehicle
//! share one link.
//!
//! The capacity is estimated with the model of a queue with one server and a fixed delay. An image that was
//! handed over at `h` cannot be acknowledged before `h` + round trip, nor before the preceding image. Any
//! additional time is its service time on the bottleneck. So the capacity is known on an idle link too, and a
//! raise can be judged without trying it. The median over [`WINDOW_S`] is used, so that single losses, which
//! cost a retransmission, do not count as a slow link.
//!
//! The controller lowers at once, to the first level that needs at most [`AIM`] of the capacity. It raises by
//! one level when the next level has needed at most [`RAISE`] of the capacity for [`PATIENCE_S`]. This delay
//! doubles after every raise that did not last, unless the level needs at most [`AMPLE`]. Without any
//! acknowledgement (an outage) the level stays for [`OUTAGE_S`].

use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::Duration;

use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{ColorMode, DepthBound, EncodeOptions};

/// Image properties that may be reduced on a slow link
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Adaptation {
    /// `none` on this computer, `quality` to private addresses, `all` to all others
    #[default]
    Auto,
    /// Nothing: images that do not fit are skipped
    None,
    /// Compression of colour and depth
    Quality,
    /// Also the rate: to a half, then a third
    Rate,
    /// Also the size of images: to a half
    All,
}

impl Adaptation {
    /// Resolves `Auto` for a peer at `address`.
    ///
    /// On one computer there is no link, only processors that may be busy. A plugin of the lab is written for
    /// its camera, so rate and size stay, and a cable that is still too slow shows as skipped images. A remote
    /// plugin is better served by fewer and smaller images than by late ones.
    pub fn toward(self, address: IpAddr) -> Self {
        match self {
            Self::Auto if address.to_canonical().is_loopback() => Self::None,
            Self::Auto if is_near(address) => Self::Quality,
            Self::Auto => Self::All,
            chosen => chosen,
        }
    }

    /// Returns the number of levels that may be used.
    fn levels(self) -> usize {
        match self {
            Self::None => 1,
            Self::Quality => 4,
            Self::Rate => 6,
            Self::Auto | Self::All => LEVELS.len(),
        }
    }
}

/// Returns whether `address` belongs to this computer or to a private network.
pub fn is_near(address: IpAddr) -> bool {
    match address.to_canonical() {
        IpAddr::V4(v4) => v4.is_loopback() || v4.is_private() || v4.is_link_local(),
        IpAddr::V6(v6) => v6.is_loopback() || v6.is_unique_local() || v6.is_unicast_link_local(),
    }
}

/// Encoding, rate and size of images at one level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Maximum JPEG quality.
    quality: u8,
    /// Colour in half resolution.
    half_colour: bool,
    /// Minimum depth error, as k. [1/m]
    depth_k: Option<f64>,
    /// One of this many images is sent.
    pub keep_one_in: u32,
    /// Divisor of width and height.
    pub shrink: u32,
    /// Bytes of an image as a share of level 0's, typical for renders of captured scenes. A wrong share costs a
    /// second change of level, because the sizes that follow are measured.
    pub share: f64,
    name: &'static str,
}

impl Level {
    /// Returns `options` reduced to this level. Options that are already lower stay unchanged.
    pub fn options(&self, options: &EncodeOptions) -> EncodeOptions {
        let mut lowered = *options;
        if self.share == 1.0 {
            return lowered;
        }
        lowered.jpeg_quality = options.jpeg_quality.min(self.quality);
        if self.half_colour {
            lowered.color_mode = ColorMode::Jpeg420;
        } else if options.color_mode == ColorMode::Lossless {
            lowered.color_mode = ColorMode::Jpeg444;
        }
        if options.depth_bound.is_none() {
            lowered.depth_bound = self.depth_k.and_then(DepthBound::new);
        }
        lowered
    }

    /// Returns a description for users: `JPEG 4:2:0 quality 80, depth within 0.001 z²`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Returns the bytes per second of this level, as a share of level 0's.
    fn load(&self) -> f64 {
        self.share / f64::from(self.keep_one_in)
    }
}

/// Returns a level by number; 0 is the best. Numbers that are too large give the smallest level.
pub fn level(index: usize) -> &'static Level {
    &LEVELS[index.min(LEVELS.len() - 1)]
}

/// All levels, from the best to the smallest.
pub static LEVELS: [Level; 7] = {
    const FULL: Level = Level {
        quality: 100,
        half_colour: false,
        depth_k: None,
        keep_one_in: 1,
        shrink: 1,
        share: 1.0,
        name: "the configured quality",
    };
    const LOW: Level = Level {
        quality: 60,
        half_colour: true,
        depth_k: Some(0.001),
        share: 0.42,
        name: "JPEG 4:2:0 quality 60, depth within 0.001 z²",
        ..FULL
    };
    [
        FULL,
        Level { quality: 85, share: 0.86, name: "JPEG quality 85", ..FULL },
        Level {
            quality: 80,
            share: 0.48,
            name: "JPEG 4:2:0 quality 80, depth within 0.001 z²",
            ..LOW
        },
        LOW,
        Level { keep_one_in: 2, name: "quality 60, every second image", ..LOW },
        Level { keep_one_in: 3, name: "quality 60, every third image", ..LOW },
        Level {
            keep_one_in: 3,
            shrink: 2,
            share: 0.15,
            name: "quality 60, every third image, half width and height",
            ..LOW
        },
    ]
};

/// Result of sending one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentImage {
    /// Size of the image.
    pub bytes: usize,
    /// Time at which its first byte was handed to the transport.
    pub handed: ServerTime,
    /// Time at which the runtime had acknowledged it, or the transport dropped it.
    pub ended: ServerTime,
    /// Whether the runtime acknowledged it.
    pub delivered: bool,
    /// Smallest round-trip time measured.
    pub min_rtt: Duration,
}

/// A change of level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Previous level.
    pub from: usize,
    /// New level.
    pub to: usize,
    /// Estimated capacity of the link. [bit/s]
    pub capacity_bps: f64,
}

impl Change {
    /// Returns a sentence for the page and the log.
    pub fn text(&self) -> String {
        let level = LEVELS[self.to].name();
        let mbit = self.capacity_bps / 1e6;
        if self.to > self.from {
            format!("the link carries {mbit:.0} Mbit/s: images lowered to {level}")
        } else {
            format!("the link carries {mbit:.0} Mbit/s: images raised to {level}")
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Sample {
    ended: ServerTime,
    bytes: f64,
    service_s: f64,
}

/// Rate controller of one session.
#[derive(Clone, Debug)]
pub struct RateController {
    levels: usize,
    level: usize,
    samples: VecDeque<Sample>,
    last_ended: ServerTime,
    /// Time since which all images were dropped.
    silent_since: Option<ServerTime>,
    /// Time at which the next better level began to fit.
    fits_since: Option<ServerTime>,
    changed: Option<ServerTime>,
    /// Whether the newest change was a raise.
    raised: bool,
    patience_s: f64,
}

impl RateController {
    /// Creates the controller; `adapt` limits the levels.
    pub fn new(adapt: Adaptation) -> Self {
        Self {
            levels: adapt.levels(),
            level: 0,
            samples: VecDeque::with_capacity(MAX_SAMPLES),
            last_ended: ServerTime::ZERO,
            silent_since: None,
            fits_since: None,
            changed: None,
            raised: false,
            patience_s: PATIENCE_S,
        }
    }

    /// Returns the current level.
    pub fn level(&self) -> &'static Level {
        &LEVELS[self.level]
    }

    /// Returns the number of the current level; 0 is the best.
    pub fn index(&self) -> usize {
        self.level
    }

    /// Records the end of an image.
    pub fn landed(&mut self, image: &SentImage) {
        let (handed, ended) = (image.handed, image.ended);
        let way_s = image.min_rtt.as_secs_f64() + ACK_DELAY_S;
        let way = handed.plus_seconds(way_s);
        let took_s = if image.delivered {
            ended.seconds_since(way.max(self.last_ended))
        } else {
            // The part that had been sent is unknown: in the worst case the image had the link to itself.
            ended.seconds_since(way)
        };
        self.last_ended = self.last_ended.max(ended);
        if image.delivered {
            let since = self.silent_since.take();
            if since.is_some_and(|since| ended.seconds_since(since) > SILENT_S) {
                // An outage gives no information about the link after it.
                self.samples.clear();
            }
        } else {
            self.silent_since.get_or_insert(ended);
        }
        // Images in flight at a change were made at the old level.
        if self.changed.is_some_and(|then| handed <= then) {
            return;
        }
        if self.samples.len() == MAX_SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(Sample {
            ended,
            bytes: image.bytes as f64,
            service_s: took_s.max(MIN_SERVICE_S),
        });
    }

    /// Updates the level, for cameras that render `wanted_hz` images per second in total. Call it every
    /// [`DECIDE_EVERY`].
    pub fn decide(&mut self, now: ServerTime, wanted_hz: f64) -> Option<Change> {
        while self.samples.front().is_some_and(|s| now.seconds_since(s.ended) > WINDOW_S) {
            self.samples.pop_front();
        }
        if self.levels == 1 || !(wanted_hz > 0.0) {
            return None;
        }
        let capacity_bps = self.capacity_bps(now)?;
        let mean_bytes =
            self.samples.iter().map(|s| s.bytes).sum::<f64>() / self.samples.len() as f64;
        let full_bps = 8.0 * mean_bytes * wanted_hz / LEVELS[self.level].share;
        let needs = |level: usize| full_bps * LEVELS[level].load() / capacity_bps;

        let to = if needs(self.level) > MAX_LOAD {
            self.fits_since = None;
            // The first level that fits, at least one lower; the last if none fits.
            let lower = self.level + 1..self.levels;
            lower.clone().find(|&level| needs(level) <= AIM).or(lower.last())
        } else if self.level > 0 && needs(self.level - 1) <= RAISE {
            let since = *self.fits_since.get_or_insert(now);
            let ample = needs(self.level - 1) <= AMPLE;
            let patience_s = if ample { PATIENCE_S } else { self.patience_s };
            (now.seconds_since(since) >= patience_s).then(|| self.level - 1)
        } else {
            self.fits_since = None;
            None
        };
        to.map(|to| self.change(now, to, capacity_bps))
    }

    fn change(&mut self, now: ServerTime, to: usize, capacity_bps: f64) -> Change {
        let from = std::mem::replace(&mut self.level, to);
        let since_s = self.changed.map_or(f64::INFINITY, |then| now.seconds_since(then));
        if to > from && self.raised && since_s < LASTS_S {
            // The raise did not last: the link is between two levels.
            self.patience_s = (2.0 * self.patience_s).min(MAX_PATIENCE_S);
        } else if self.raised && since_s > MAX_PATIENCE_S {
            self.patience_s = PATIENCE_S;
        }
        (self.raised, self.changed, self.fits_since) = (to < from, Some(now), None);
        self.samples.clear();
        Change { from, to, capacity_bps }
    }

    /// Returns the estimated capacity of the link; `None` if unknown.
    fn capacity_bps(&self, now: ServerTime) -> Option<f64> {
        let silent_s = self.silent_since.map_or(0.0, |since| now.seconds_since(since));
        let is_out = silent_s > SILENT_S && silent_s < OUTAGE_S;
        if self.samples.len() < MIN_SAMPLES || is_out {
            return None;
        }
        let mut rates: Vec<f64> =
            self.samples.iter().map(|s| 8.0 * s.bytes / s.service_s).collect();
        rates.sort_unstable_by(f64::total_cmp);
        Some(rates[rates.len() / 2])
    }
}

/// Interval of calls of [`RateController::decide`].
pub const DECIDE_EVERY: Duration = Duration::from_millis(250);
/// Window of the capacity estimate: enough for a median at 20 Hz, and longer than an outage. [s]
const WINDOW_S: f64 = 3.0;
/// Minimum samples: an eighth of a second at 60 Hz, half a second at the lowest rates.
const MIN_SAMPLES: usize = 8;
/// Maximum samples: 640 bytes a session; more than a second at 60 Hz.
const MAX_SAMPLES: usize = 64;
/// Share of the capacity above which the level is lowered: packets have headers (3 %), and a queue at full load
/// never empties.
const MAX_LOAD: f64 = 0.9;
/// Maximum share of the capacity for the level chosen when lowering.
const AIM: f64 = 0.8;
/// Maximum share of the capacity for a raise. It is below [`MAX_LOAD`] by more than the sizes of adjacent
/// levels vary with the scene.
const RAISE: f64 = 0.7;
/// Below this share of the capacity, a raise does not wait longer because an earlier one did not last.
const AMPLE: f64 = 0.4;
/// Time for which the next better level must fit. [s]
const PATIENCE_S: f64 = 2.0;
/// Maximum time between attempts to raise, for a link between two levels. [s]
const MAX_PATIENCE_S: f64 = 32.0;
/// A raise that is reverted within this time did not last. [s]
const LASTS_S: f64 = 10.0;
/// Without any acknowledgement for this long, the cause is not an outage, but a link that carries no image of
/// this size before its deadline. [s]
const OUTAGE_S: f64 = 2.5;
/// Time without an acknowledgement that counts as an outage: more than a few dropped images in a row. [s]
const SILENT_S: f64 = 0.5;
/// `max_ack_delay` of the runtime, which is not a delay of the link. [s]
const ACK_DELAY_S: f64 = 0.002;
/// Minimum service time: shorter ones are below the delays of clock and tasks. [s]
const MIN_SERVICE_S: f64 = 0.0002;

#[cfg(test)]
mod tests;
