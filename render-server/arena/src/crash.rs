//! Analysis of a failed flight: its probable cause in a sentence, and drawings of its end. Pure; the report of
//! a grade and the page's crash card show the same.
//!
//! ```text
//! verdict, samples, replies, images   --> probable_cause --> a sentence
//! samples, obstacles at its height    --> plot           --> SVG
//! ```

mod cause;
pub mod plot;
#[cfg(test)]
mod tests;

pub use cause::probable_cause;

use vizflyt_protocol::messages::Setpoint;
use vizflyt_protocol::time::ServerTime;

use crate::verdict::{Sample, Verdict};

/// A reply of the plugin, with the time of its image.
#[derive(Clone, Debug)]
pub struct TimedSetpoint {
    /// Time at which the plugin received the image.
    pub stamp: ServerTime,
    /// Setpoint of the reply, if it has one.
    pub setpoint: Option<Setpoint>,
}

/// Free distance ahead in an image of the first camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClearanceAhead {
    pub stamp: ServerTime,
    /// Result of [`ahead_m`]. [m, cam]
    pub ahead_m: Option<f64>,
}

/// Record of a completed flight.
#[derive(Clone, Copy, Debug)]
pub struct Flight<'a> {
    pub verdict: &'a Verdict,
    /// Samples in order of time.
    pub samples: &'a [Sample],
    /// Replies of the plugin in order; `None` if not recorded, as in a lab.
    pub asked: Option<&'a [TimedSetpoint]>,
    /// Free distances ahead in order.
    pub seen: &'a [ClearanceAhead],
    /// Last line that the plugin printed.
    pub last_line: Option<&'a str>,
    /// Delay from rendering an image until the reply takes effect. [s]
    pub delay_s: f64,
}

/// Returns the samples of the last `seconds` until `at`.
pub fn since(samples: &[Sample], at: ServerTime, seconds: f64) -> &[Sample] {
    let begin = samples.partition_point(|sample| at.seconds_since(sample.stamp) > seconds);
    let end = samples.partition_point(|sample| sample.stamp <= at);
    samples.get(begin..end).unwrap_or_default()
}

/// Returns the free distance ahead in an image `width_px` wide: the tenth percentile of the depths in the
/// middle ninth, which excludes single pixels. Zero depths do not count; `None` without any depth. [m, cam]
pub fn ahead_m(depth_mm: &[u16], width_px: usize, scratch: &mut Vec<u16>) -> Option<f64> {
    let height = depth_mm.len().checked_div(width_px)?;
    let rows = depth_mm.chunks_exact(width_px).skip(height / 3).take(height / 3);
    let middle = rows.flat_map(|row| &row[width_px / 3..2 * width_px / 3]);
    scratch.clear();
    scratch.extend(middle.filter(|&&mm| mm > 0));
    let nth = scratch.len() / 10;
    if scratch.is_empty() {
        return None;
    }
    let (_, &mut mm, _) = scratch.select_nth_unstable(nth);
    Some(f64::from(mm) / 1000.0)
}
