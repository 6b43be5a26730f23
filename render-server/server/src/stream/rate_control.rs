//! What to give up when the link is too slow: quality before rate, rate before resolution.
//!
//! ```text
//! every image that ends (bytes, handed, acknowledged or given up) -> capacity of the link
//! four times a second: what each level would need of it            -> level
//! level -> encoder's options, frame decimation, size
//! ```
//! Pure: no clock, no socket. One [`RateController`] per session, for all cameras of its vehicle share one
//! link.
//!
//! The capacity is measured as of a queue with one server and a fixed way: an image that was handed
//! over at `h` cannot be acknowledged before `h` + round trip, nor before the image ahead of it; what
//! it took longer is its own time on the bottleneck. So it is known on an idle link too, and a raise
//! need not be tried to be judged. The median over [`WINDOW_S`] is taken, so that single losses,
//! which cost a retransmission, do not count as a slow link.
//!
//! Down at once, to the first level that needs at most [`AIM`] of the capacity; up by one level when
//! the next has needed at most [`RAISE`] of it for [`PATIENCE_S`], twice as long after every raise
//! that did not last, unless the room is [`AMPLE`]. Without any acknowledgement (an outage) the level stays for [`OUTAGE_S`].

use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::Duration;

use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{ColorMode, DepthBound, EncodeOptions};

/// What may be lowered when a link is too slow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Adaptation {
    /// `none` on this computer, `quality` to private addresses, `all` to all others.
    #[default]
    Auto,
    /// Nothing: images are as asked for, or do not come.
    None,
    /// Compression of colour and depth.
    Quality,
    /// Also the rate: to a half, then a third.
    Rate,
    /// Also the size of images: to a half.
    All,
}

impl Adaptation {
    /// Returns what it means toward a peer at `address`.
    ///
    /// On one computer there is no link, only processors that may be busy. A plugin of the lab is
    /// written for its camera: there rate and size stay, and a cable that is too slow even so shows
    /// as skipped images. A remote one is better served by fewer and smaller images than by late
    /// ones.
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

/// Whether `address` is this computer's or of a private network.
pub fn is_near(address: IpAddr) -> bool {
    match address.to_canonical() {
        IpAddr::V4(v4) => v4.is_loopback() || v4.is_private() || v4.is_link_local(),
        IpAddr::V6(v6) => v6.is_loopback() || v6.is_unique_local() || v6.is_unicast_link_local(),
    }
}

/// How images are made at one level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// JPEG quality at most.
    quality: u8,
    /// Colour in half resolution.
    half_colour: bool,
    /// Depth error at least, as k. [1/m]
    depth_k: Option<f64>,
    /// One of so many images is sent.
    pub keep_one_in: u32,
    /// Width and height are divided by this.
    pub shrink: u32,
    /// Bytes of an image, as a share of level 0's: about what renders of captured scenes take. A
    /// wrong share costs a second change, as what follows is measured.
    pub share: f64,
    name: &'static str,
}

impl Level {
    /// Returns `options` lowered to this level; what was asked for lower stays as it is.
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

    /// Returns its description for people: `JPEG 4:2:0 quality 80, depth within 0.001 z²`.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Returns the bytes per second it needs, as a share of level 0's.
    fn load(&self) -> f64 {
        self.share / f64::from(self.keep_one_in)
    }
}

/// Returns the level of this number, 0 being the best; the smallest, if there are fewer.
pub fn level(index: usize) -> &'static Level {
    &LEVELS[index.min(LEVELS.len() - 1)]
}

/// From the best to the smallest.
pub static LEVELS: [Level; 7] = {
    const FULL: Level = Level {
        quality: 100,
        half_colour: false,
        depth_k: None,
        keep_one_in: 1,
        shrink: 1,
        share: 1.0,
        name: "as asked for",
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

/// The end of one image's way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentImage {
    /// How large it was.
    pub bytes: usize,
    /// When its first byte was handed to the transport.
    pub handed: ServerTime,
    /// When the runtime had acknowledged it, or it was given up.
    pub ended: ServerTime,
    /// Acknowledged.
    pub delivered: bool,
    /// The least round trip known.
    pub min_rtt: Duration,
}

/// A change of level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Before.
    pub from: usize,
    /// From now on.
    pub to: usize,
    /// What the link carries, by the landings. [bit/s]
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

/// The policy of one session.
#[derive(Clone, Debug)]
pub struct RateController {
    levels: usize,
    level: usize,
    samples: VecDeque<Sample>,
    last_ended: ServerTime,
    /// Since when images have only been given up.
    silent_since: Option<ServerTime>,
    /// When the next better level began to fit.
    fits_since: Option<ServerTime>,
    changed: Option<ServerTime>,
    /// Whether the newest change was a raise.
    raised: bool,
    patience_s: f64,
}

impl RateController {
    /// Makes the policy; `adapt` limits how far it may go.
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

    /// Returns how images are to be made now.
    pub fn level(&self) -> &'static Level {
        &LEVELS[self.level]
    }

    /// Returns the number of the present level; 0 is the best.
    pub fn index(&self) -> usize {
        self.level
    }

    /// Takes note of an image's end.
    pub fn landed(&mut self, image: &SentImage) {
        let (handed, ended) = (image.handed, image.ended);
        let way_s = image.min_rtt.as_secs_f64() + ACK_DELAY_S;
        let way = handed.plus_seconds(way_s);
        let took_s = if image.delivered {
            ended.seconds_since(way.max(self.last_ended))
        } else {
            // How much of it had left is not known: at worst it had the link to itself.
            ended.seconds_since(way)
        };
        self.last_ended = self.last_ended.max(ended);
        if image.delivered {
            let since = self.silent_since.take();
            if since.is_some_and(|since| ended.seconds_since(since) > SILENT_S) {
                // An outage has no information about the link that came back.
                self.samples.clear();
            }
        } else {
            self.silent_since.get_or_insert(ended);
        }
        // What was under way when the level changed was made at the old one.
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

    /// Decides anew, for cameras that would like `wanted_hz` images a second in all; call it every
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
            // The first that fits, but one lower at least; the last if none does.
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

    /// Returns what the link carries; `None` while that is not known.
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

/// How often to [`RateController::decide`].
pub const DECIDE_EVERY: Duration = Duration::from_millis(250);
/// Images of the last so many seconds count: enough for a median at 20 Hz, and an outage fits. [s]
const WINDOW_S: f64 = 3.0;
/// An eighth of a second at 60 Hz; at the lowest rates half a second.
const MIN_SAMPLES: usize = 8;
/// 640 bytes a session; a second and more at 60 Hz.
const MAX_SAMPLES: usize = 64;
/// Share of the capacity above which a level is too much: packets have headers (3 %), and a queue
/// at full load never empties.
const MAX_LOAD: f64 = 0.9;
/// Share of the capacity that a lower level is chosen by.
const AIM: f64 = 0.8;
/// Share of the capacity that a raise may need: below [`MAX_LOAD`] by more than levels next to each
/// other vary with the scene.
const RAISE: f64 = 0.7;
/// Below this share of the capacity a raise that did not last before is no reason to wait.
const AMPLE: f64 = 0.4;
/// How long the next better level must fit. [s]
const PATIENCE_S: f64 = 2.0;
/// Where the link is just between two levels: one try in so long. [s]
const MAX_PATIENCE_S: f64 = 32.0;
/// A raise that is taken back within this did not last. [s]
const LASTS_S: f64 = 10.0;
/// Without any acknowledgement for so long it is no outage but a link that carries nothing of this
/// size before its deadline. [s]
const OUTAGE_S: f64 = 2.5;
/// More than a few images given up in a row. [s]
const SILENT_S: f64 = 0.5;
/// The runtime's `max_ack_delay`: not the link's doing. [s]
const ACK_DELAY_S: f64 = 0.002;
/// What is quicker cannot be distinguished from the clock's and the tasks' own delays. [s]
const MIN_SERVICE_S: f64 = 0.0002;

#[cfg(test)]
mod tests;
