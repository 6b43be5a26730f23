//! Data of a flight for its report: last lines of the plugin, and images of the whole flight.

use std::collections::VecDeque;

use vizflyt_protocol::time::ServerTime;
use vizflyt_runtime::supervisor::Stream;

use super::TrialImage;

/// Maximum number of images of a whole flight in the report; any flight of a few seconds has at
/// least half as many.
const KEYFRAMES: usize = 16;
/// Minimum interval between two of them. [s]
const KEYFRAME_PERIOD_S: f64 = 0.25;
/// Maximum number of stored lines of the plugin.
const LINES: usize = 200;

/// Output of the plugin.
#[derive(Debug, Default)]
pub(super) struct Lines {
    /// Last lines.
    pub(super) kept: VecDeque<String>,
    /// Lines that are not logged yet.
    pub(super) fresh: Vec<(Stream, String)>,
}

impl Lines {
    /// Returns the receiver of lines.
    pub(super) fn sink(&mut self) -> impl FnMut(Stream, &str) {
        |stream, text| {
            if self.kept.len() == LINES {
                self.kept.pop_front();
            }
            self.kept.push_back(text.to_owned());
            self.fresh.push((stream, text.to_owned()));
        }
    }
}

/// Images evenly spread over a flight of any duration.
#[derive(Debug)]
pub(super) struct Keyframes {
    pub(super) images: Vec<TrialImage>,
    period_s: f64,
}

impl Default for Keyframes {
    fn default() -> Self {
        Self { images: Vec::new(), period_s: KEYFRAME_PERIOD_S }
    }
}

impl Keyframes {
    /// Stores the image of this instant if one is due.
    pub(super) fn take(&mut self, stamp: ServerTime, image: impl FnOnce() -> TrialImage) {
        let is_due = self
            .images
            .last()
            .is_none_or(|last| stamp.seconds_since(last.stamp) >= self.period_s - 0.5 * 2.5e-3);
        if !is_due {
            return;
        }
        self.images.push(image());
        if self.images.len() > KEYFRAMES {
            let mut index = 0;
            self.images.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.period_s *= 2.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_keyframes_over_any_flight() {
        for seconds in [3, 10, 60, 600] {
            let mut keyframes = Keyframes::default();
            for image in 0..seconds * 30 {
                let stamp = ServerTime::from_ns(image * 33_333_333);
                let image = || TrialImage { stamp, rgb: Vec::new(), size_px: (0, 0) };
                keyframes.take(stamp, image);
            }
            let stamps: Vec<_> = keyframes.images.iter().map(|image| image.stamp).collect();
            let gaps = || stamps.windows(2).map(|pair| pair[1].seconds_since(pair[0]));
            let (least, most) = (gaps().reduce(f64::min), gaps().reduce(f64::max));
            assert!((KEYFRAMES / 2..=KEYFRAMES).contains(&stamps.len()), "{seconds} s: {stamps:?}");
            assert!(most.unwrap() < 1.4 * least.unwrap(), "{seconds} s: {least:?} {most:?}");
        }
    }
}
