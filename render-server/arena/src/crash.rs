//! The analysis of a failed flight: its probable cause in a sentence, and drawings of its end.
//! Pure; the autograder's report and the page's crash card show the same.
//!
//! ```text
//! verdict, samples, answers, images   --> probable_cause --> a sentence
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

/// A reply of the plugin, and its image's time.
#[derive(Clone, Debug)]
pub struct TimedSetpoint {
    /// When the plugin was given the image.
    pub stamp: ServerTime,
    /// Its setpoint, if it sent one.
    pub setpoint: Option<Setpoint>,
}

/// The free distance ahead in an image of the first camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClearanceAhead {
    /// When the image was new.
    pub stamp: ServerTime,
    /// By [`ahead_m`]. [m, cam]
    pub ahead_m: Option<f64>,
}

/// The record of a flight that is over.
#[derive(Clone, Copy, Debug)]
pub struct Flight<'a> {
    /// Its verdict.
    pub verdict: &'a Verdict,
    /// Where it was, in order.
    pub samples: &'a [Sample],
    /// The plugin's replies, in order; `None` where they were not recorded, as in a lab.
    pub asked: Option<&'a [TimedSetpoint]>,
    /// The distances ahead, in order.
    pub seen: &'a [ClearanceAhead],
    /// The last line that the plugin printed.
    pub last_line: Option<&'a str>,
    /// From when an image is rendered until its reply counts. [s]
    pub delay_s: f64,
}

/// Returns the samples of the last `seconds` until `at`.
pub fn since(samples: &[Sample], at: ServerTime, seconds: f64) -> &[Sample] {
    let begin = samples.partition_point(|sample| at.seconds_since(sample.stamp) > seconds);
    let end = samples.partition_point(|sample| sample.stamp <= at);
    samples.get(begin..end).unwrap_or_default()
}

/// Returns the tenth percentile of the depths in the middle ninth of an image `width_px` wide: what is
/// ahead, single pixels aside; `None` where nothing is. Zero depths are none. [m, cam]
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
