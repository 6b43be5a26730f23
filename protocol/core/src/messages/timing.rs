//! Latency from pose to setpoint, in nine stages.
//!
//! ```text
//! measured  render  render   encode    first byte   last byte  decode  plugin  plugin  setpoint
//!   pose    starts   ends     ends     received     received    ends   starts   ends    leaves
//!    |-------|--------|---------|-----------|-----------|---------|-------|-------|--------|
//!      pose   render    encode      send       receive    decode  handover plugin  setpoint
//!    |<------------------------------ age -------------------------->|
//!    |<------------------------------------- total --------------------------------------->|
//! ```
//! A stage counts only the time that it *adds* after the previous one: if sending overlaps encoding, only the remainder
//! counts as sending. The stages of one image therefore add up to its total.

use serde::{Deserialize, Serialize};

use super::MAX_CAMERAS;

/// Stage of an image's latency. The names are also used in tracing spans, reports and on the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// From the measurement of the pose to the start of rendering: localization, network, fusion, waiting for the
    /// renderer.
    Pose,
    /// Rendering all cameras of the tick.
    Render,
    /// Waiting for the encoder, and encoding.
    Encode,
    /// Until the first byte of the image is on the runtime's computer.
    Send,
    /// Until the last byte is there.
    Receive,
    /// Waiting for the decoder, and decoding into shared memory.
    Decode,
    /// Until the call of the plugin's `on_image`: waiting for other cameras of the tick, or a busy plugin.
    Handover,
    /// Inside `on_image`.
    Plugin,
    /// Until the MAVLink setpoint with the answer is sent.
    Setpoint,
}

impl Stage {
    /// All stages, in order.
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

    /// Returns the name of the stage.
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

/// One value per stage.
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
    /// Calls `value` for each stage.
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

/// Latency of a number of images, by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Waterfall {
    /// Images delivered to the plugin.
    pub images: u64,
    /// Number of these images whose answer was sent as a setpoint. Only they count in `setpoint` and `total`.
    pub answered: u64,
    /// Latency of each stage. [ms]
    pub stages: Stages<StageTimes>,
    /// Time from pose stamp to the start of the plugin. [ms]
    pub age: StageTimes,
    /// Time from pose stamp to the setpoint. [ms]
    pub total: StageTimes,
    /// Images that seemed to arrive before they were sent, within the error bound of the clocks. Their `send` counts as
    /// 0.
    pub clamped: u64,
    /// Images that seemed to arrive earlier than the bound allows: a clock was set, or the bound is wrong.
    pub out_of_bound: u64,
}

/// Upper edges of the bins of [`Intervals`]. [ms]
pub const INTERVAL_EDGES_MS: [f32; 19] = [
    2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0, 70.0,
    100.0, 200.0, 500.0,
];

/// Intervals between consecutive images at the plugin. Their spread is the jitter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Intervals {
    /// Percentiles of the intervals. [ms]
    pub times: StageTimes,
    /// Number of intervals in each bin. A bin ends below its edge in [`INTERVAL_EDGES_MS`]; the last bin has no upper
    /// edge.
    pub bins: [u32; INTERVAL_EDGES_MS.len() + 1],
}

impl Intervals {
    /// Returns the bin of an interval. [ms]
    pub fn bin(ms: f64) -> usize {
        INTERVAL_EDGES_MS.iter().position(|&edge| ms < f64::from(edge)).unwrap_or(19)
    }
}

/// Fate of the images of one camera that arrived completely at the runtime since its start.
///
/// `arrived` is the sum of the others and of the images in progress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Arrivals {
    /// Arrived completely.
    pub arrived: u64,
    /// Delivered to the plugin.
    pub delivered: u64,
    /// Older than an image that was already there, or without a known time.
    pub stale: u64,
    /// Could not be decoded.
    pub broken: u64,
    /// Replaced by a newer one while waiting for the decoder.
    pub superseded: u64,
    /// Decoded, but replaced by a newer one before the idle plugin took it.
    pub unasked: u64,
    /// Decoded, but replaced by a newer one while the plugin was busy with an earlier one.
    pub overrun: u64,
}

impl Arrivals {
    /// Returns the number of images that are no longer in progress.
    pub fn ended(&self) -> u64 {
        self.delivered + self.stale + self.broken + self.superseded + self.unasked + self.overrun
    }
}

/// Offset of the server's clock from the runtime's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ClockState {
    /// Value to add to the runtime's time to get the server's time. [ns]
    pub offset_ns: i64,
    /// Bound of the offset's error. [ms]
    pub error_bound_ms: f32,
    /// Drift, positive if the server's clock runs faster. [ppm]
    pub drift_ppm: f32,
    /// Bound of the drift's error. [ppm]
    pub drift_bound_ppm: f32,
    /// Number of times that a clock was set or restarted.
    pub steps: u32,
}

/// Latency report of the runtime, at 1 Hz.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Duration that `waterfall` and `intervals` cover: the last seconds, or the whole flight. [s]
    pub seconds: f32,
    /// Latency by stage.
    pub waterfall: Waterfall,
    /// Intervals between images (jitter).
    pub intervals: Intervals,
    /// Clock offset; `None` before the first exchange.
    pub clock: Option<ClockState>,
    /// Fate of the images, by camera.
    pub cameras: heapless::Vec<Arrivals, MAX_CAMERAS>,
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;

    #[test]
    fn stages_have_the_names_of_their_fields() {
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
