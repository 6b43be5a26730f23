//! Where an image's age comes from: the way from pose to setpoint in nine stages.
//!
//! ```text
//! measured  render  render   encode    first byte   last byte  decode  plugin  plugin  setpoint
//!   pose    starts   ends     ends     received     received    ends   starts   ends    leaves
//!    |-------|--------|---------|-----------|-----------|---------|-------|-------|--------|
//!      pose   render    encode      send       receive    decode  handover plugin  setpoint
//!    |<------------------------------ age -------------------------->|
//!    |<------------------------------------- total --------------------------------------->|
//! ```
//! A stage is what it *adds* after the one before it: where sending overlaps encoding, only the
//! rest of it counts. So the stages of one image sum up to its total exactly.

use serde::{Deserialize, Serialize};

use super::MAX_CAMERAS;

/// A stage of an image's way. The names are those of tracing spans, reports and the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// The vehicle was measured, until rendering starts: localization, network, fusion, waiting
    /// for the renderer.
    Pose,
    /// Drawing all cameras of the tick.
    Render,
    /// Waiting for the encoder, and encoding.
    Encode,
    /// Until the image's first byte is on the runtime's computer.
    Send,
    /// Until its last byte is.
    Receive,
    /// Waiting for the decoder, and decoding into shared memory.
    Decode,
    /// Until the plugin's `on_image` is entered: other cameras of the tick, a plugin that is busy.
    Handover,
    /// Inside `on_image`.
    Plugin,
    /// Until the MAVLink setpoint that carries the answer leaves.
    Setpoint,
}

impl Stage {
    /// All of them, in order.
    pub const ALL: [Self; 9] = [
        Self::Pose,
        Self::Render,
        Self::Encode,
        Self::Send,
        Self::Receive,
        Self::Decode,
        Self::Handover,
        Self::Plugin,
        Self::Setpoint,
    ];

    /// Returns the stage's name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pose => "pose",
            Self::Render => "render",
            Self::Encode => "encode",
            Self::Send => "send",
            Self::Receive => "receive",
            Self::Decode => "decode",
            Self::Handover => "handover",
            Self::Plugin => "plugin",
            Self::Setpoint => "setpoint",
        }
    }
}

/// Percentiles of a duration. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageTimes {
    /// Median. [ms]
    pub p50: f32,
    /// 90th percentile. [ms]
    pub p90: f32,
    /// 99th percentile. [ms]
    pub p99: f32,
    /// Longest. [ms]
    pub max: f32,
}

/// One value for each stage, by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)] // Why: the fields are the stages, described there.
pub struct Stages<T> {
    pub pose: T,
    pub render: T,
    pub encode: T,
    pub send: T,
    pub receive: T,
    pub decode: T,
    pub handover: T,
    pub plugin: T,
    pub setpoint: T,
}

impl<T> Stages<T> {
    /// Makes one value for each stage.
    pub fn from_fn(mut value: impl FnMut(Stage) -> T) -> Self {
        Self {
            pose: value(Stage::Pose),
            render: value(Stage::Render),
            encode: value(Stage::Encode),
            send: value(Stage::Send),
            receive: value(Stage::Receive),
            decode: value(Stage::Decode),
            handover: value(Stage::Handover),
            plugin: value(Stage::Plugin),
            setpoint: value(Stage::Setpoint),
        }
    }
}

impl<T> core::ops::Index<Stage> for Stages<T> {
    type Output = T;

    fn index(&self, stage: Stage) -> &T {
        match stage {
            Stage::Pose => &self.pose,
            Stage::Render => &self.render,
            Stage::Encode => &self.encode,
            Stage::Send => &self.send,
            Stage::Receive => &self.receive,
            Stage::Decode => &self.decode,
            Stage::Handover => &self.handover,
            Stage::Plugin => &self.plugin,
            Stage::Setpoint => &self.setpoint,
        }
    }
}

impl<T> core::ops::IndexMut<Stage> for Stages<T> {
    fn index_mut(&mut self, stage: Stage) -> &mut T {
        match stage {
            Stage::Pose => &mut self.pose,
            Stage::Render => &mut self.render,
            Stage::Encode => &mut self.encode,
            Stage::Send => &mut self.send,
            Stage::Receive => &mut self.receive,
            Stage::Decode => &mut self.decode,
            Stage::Handover => &mut self.handover,
            Stage::Plugin => &mut self.plugin,
            Stage::Setpoint => &mut self.setpoint,
        }
    }
}

/// The ages of a number of images, by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Waterfall {
    /// Images that the plugin was given.
    pub images: u64,
    /// Those of them whose answer left as a setpoint; only they count in `setpoint` and `total`.
    pub answered: u64,
    /// Each stage. [ms]
    pub stages: Stages<StageTimes>,
    /// Pose stamp to the start of the plugin. [ms]
    pub age: StageTimes,
    /// Pose stamp to the setpoint. [ms]
    pub total: StageTimes,
    /// Images that seemed to arrive before they were sent, by no more than the clocks' error
    /// bound: their `send` counts as 0.
    pub clamped: u64,
    /// The same by more than the bound: a clock was set, or the bound is wrong.
    pub out_of_bound: u64,
}

/// Edges of the bins of [`Intervals`]. [ms]
pub const INTERVAL_EDGES_MS: [f32; 19] = [
    2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0, 70.0,
    100.0, 200.0, 500.0,
];

/// Times between an image at the plugin and the next: their spread is the jitter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Intervals {
    /// Their percentiles. [ms]
    pub times: StageTimes,
    /// How many fell below each edge of [`INTERVAL_EDGES_MS`] and not below the one before; the
    /// last bin has the rest.
    pub bins: [u32; INTERVAL_EDGES_MS.len() + 1],
}

impl Intervals {
    /// Returns the bin of an interval. [ms]
    pub fn bin(ms: f64) -> usize {
        INTERVAL_EDGES_MS.iter().position(|&edge| ms < f64::from(edge)).unwrap_or(19)
    }
}

/// What became of the images of one camera that reached the runtime whole, since it started.
///
/// `arrived` is the sum of the others and of those still under way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Arrivals {
    /// Came whole.
    pub arrived: u64,
    /// Given to the plugin.
    pub delivered: u64,
    /// Older than one that was there already, or of no known time.
    pub stale: u64,
    /// Did not decode.
    pub broken: u64,
    /// A newer one came while it waited for the decoder.
    pub superseded: u64,
    /// Decoded; a newer one was there before the plugin, idle, had asked.
    pub unasked: u64,
    /// Decoded; a newer one was there before the plugin had done with an earlier one.
    pub overrun: u64,
}

impl Arrivals {
    /// Returns how many have found their end.
    pub fn ended(&self) -> u64 {
        self.delivered + self.stale + self.broken + self.superseded + self.unasked + self.overrun
    }
}

/// The relation of the server's clock to the runtime's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockState {
    /// What is added to the runtime's time to give the server's. [ns]
    pub offset_ns: i64,
    /// Bound of its error. [ms]
    pub error_bound_ms: f32,
    /// How much faster the server's clock runs. [ppm]
    pub drift_ppm: f32,
    /// Bound of its error. [ppm]
    pub drift_bound_ppm: f32,
    /// How often a clock was set or restarted.
    pub steps: u32,
}

/// The runtime's report of times. 1 Hz.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// What `waterfall` and `intervals` cover: the last seconds, or the whole flight. [s]
    pub seconds: f32,
    /// Ages.
    pub waterfall: Waterfall,
    /// Jitter.
    pub intervals: Intervals,
    /// The clocks; `None` before the first exchange.
    pub clock: Option<ClockState>,
    /// What became of the images, by camera.
    pub cameras: heapless::Vec<Arrivals, MAX_CAMERAS>,
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;

    #[test]
    fn stages_are_named_as_their_fields() {
        let stages = Stages::from_fn(Stage::name);
        let json = serde_json::to_value(stages).unwrap();
        for stage in Stage::ALL {
            assert_eq!(stages[stage], stage.name());
            assert_eq!(json[stage.name()], stage.name());
            assert_eq!(serde_json::to_value(stage).unwrap(), stage.name());
        }
        assert_eq!(json.as_object().unwrap().len(), Stage::ALL.len());
    }

    #[test]
    fn bins_cover_every_interval() {
        assert!(INTERVAL_EDGES_MS.is_sorted_by(|a, b| a < b));
        for (ms, bin) in [(-1.0, 0), (0.0, 0), (2.0, 1), (16.7, 8), (499.9, 18), (1e9, 19)] {
            assert_eq!(Intervals::bin(ms), bin, "{ms} ms");
        }
        assert_eq!(Intervals::bin(f64::NAN), 19);
    }
}
