//! Detects camera faults. Sans-IO.
//!
//! Input: each image on arrival, the end of a source, and the time. Output: whether an image is usable for
//! localization, and a message about the fault. A driver that hangs sends no images; a driver that is stuck repeats an
//! old image with a new stamp; a covered lens gives black images.

use std::collections::VecDeque;

use crate::image::Gray;

/// Fault detection of one camera.
///
/// ```
/// use vizflyt_tags::capture::CameraWatch;
/// use vizflyt_tags::image::Gray;
/// let mut camera = CameraWatch::new(0);
/// let image = Gray::plain(64, 48, 200);
/// assert!(camera.handle_image(1_000_000, &image));
/// assert!(!camera.handle_image(34_000_000, &image), "images of a real sensor always differ");
/// assert_eq!(camera.fault(35_000_000).unwrap(), "repeats an image: its driver is stuck");
/// assert_eq!(camera.fault(900_000_000).unwrap(), "no image for 0.9 s");
/// ```
#[derive(Clone, Debug)]
pub struct CameraWatch {
    /// Hashes of the latest images.
    hashes: VecDeque<u64>,
    /// Arrival of the last image. [ns]
    arrived_ns: u64,
    /// Fault of the last image.
    unfit: Option<&'static str>,
    /// Why the source ended, until the next image.
    ended: Option<String>,
}

impl CameraWatch {
    /// Makes a watch for a source opened at `now_ns`.
    pub fn new(now_ns: u64) -> Self {
        Self { hashes: VecDeque::new(), arrived_ns: now_ns, unfit: None, ended: None }
    }

    /// Checks an image; returns whether it is usable for localization.
    pub fn handle_image(&mut self, now_ns: u64, image: &Gray) -> bool {
        let hash = hash(image.pixels());
        let repeats = self.hashes.contains(&hash);
        if !repeats {
            self.hashes.push_back(hash);
            if self.hashes.len() > MAX_HASHES {
                self.hashes.pop_front();
            }
        }
        let brightest = image.pixels().iter().step_by(SAMPLED).max().copied().unwrap_or(0);
        self.unfit = if brightest < DARK {
            Some("sees nothing: it is dark, or its lens is covered")
        } else if repeats {
            Some("repeats an image: its driver is stuck")
        } else {
            None
        };
        self.arrived_ns = now_ns;
        self.ended = None;
        self.unfit.is_none()
    }

    /// Records why the source ended.
    pub fn handle_end(&mut self, why: String) {
        self.ended = Some(why);
    }

    /// Returns the present fault; `None` for a working camera.
    pub fn fault(&self, now_ns: u64) -> Option<String> {
        if let Some(why) = &self.ended {
            return Some(why.clone());
        }
        let silent_ns = now_ns.saturating_sub(self.arrived_ns);
        if silent_ns > SILENT_NS {
            // Rounded to tenths, so that the message does not change with every call.
            return Some(format!("no image for {:.1} s", silent_ns as f64 / 1e9));
        }
        self.unfit.map(str::to_owned)
    }
}

/// Returns a hash that is unlikely to be the same for two different images: multiplicative, eight bytes at a time. 1280
/// x 720 take 0.1 ms.
fn hash(bytes: &[u8]) -> u64 {
    let mut words = bytes.chunks_exact(8);
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    for word in &mut words {
        let word = word.iter().fold(0u64, |sum, byte| sum << 8 | u64::from(*byte));
        hash = (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
    }
    words
        .remainder()
        .iter()
        .fold(hash, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

/// Number of compared images: a stuck driver repeats its buffers, one or all in turn.
const MAX_HASHES: usize = 8;
/// Time without images that is a fault. The slowest camera has 10 Hz, and the fault is reported within half a second.
/// [ns]
const SILENT_NS: u64 = 350_000_000;
/// Maximum brightness of a dark image, in which no tag is readable. [grey levels of 255]
const DARK: u8 = 24;
/// Every 61st pixel is tested. Since row lengths are not multiples of it, this covers all columns.
const SAMPLED: usize = 61;

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(seed: u8) -> Gray {
        let pixels = (0..64 * 48u32).map(|i| (i as u8).wrapping_mul(7).wrapping_add(seed));
        Gray::new(64, 48, pixels.collect()).unwrap()
    }

    #[test]
    fn clears_the_fault_when_a_camera_recovers() {
        let ms = 1_000_000;
        let mut camera = CameraWatch::new(0);
        let check = |camera: &CameraWatch, at_ms: u64, expected: Option<&str>| {
            assert_eq!(camera.fault(at_ms * ms).as_deref(), expected);
        };
        check(&camera, 100, None);
        check(&camera, 400, Some("no image for 0.4 s"));
        assert!(camera.handle_image(500 * ms, &picture(1)));
        check(&camera, 600, None);
        // The buffers repeat.
        for (i, seed) in [2, 3, 4].into_iter().enumerate() {
            assert!(camera.handle_image((500 + i as u64) * ms, &picture(seed)));
        }
        for seed in [2, 3, 4, 2] {
            assert!(!camera.handle_image(520 * ms, &picture(seed)));
        }
        check(&camera, 530, Some("repeats an image: its driver is stuck"));
        assert!(!camera.handle_image(540 * ms, &Gray::plain(64, 48, 3)));
        check(&camera, 550, Some("sees nothing: it is dark, or its lens is covered"));
        camera.handle_end("left: unplugged".into());
        check(&camera, 560, Some("left: unplugged"));
        assert!(camera.handle_image(700 * ms, &picture(9)));
        check(&camera, 710, None);
    }
}
