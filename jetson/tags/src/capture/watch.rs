//! Is a camera still what it was? Sans-IO.
//!
//! What enters: each image as it comes, why a source ended, and the time. What leaves: whether an image is one to be
//! located by, and what is wrong in words. A driver that hangs sends nothing; one that is stuck sends an old image
//! again under a new stamp; a lens that is covered sends black.

use std::collections::VecDeque;

use crate::image::Gray;

/// Watches one camera.
///
/// ```
/// use vizflyt_tags::capture::CameraWatch;
/// use vizflyt_tags::image::Gray;
/// let mut camera = CameraWatch::new(0);
/// let image = Gray::plain(64, 48, 200);
/// assert!(camera.handle_image(1_000_000, &image));
/// assert!(!camera.handle_image(34_000_000, &image), "no sensor sees the same twice");
/// assert_eq!(camera.fault(35_000_000).unwrap(), "repeats an image: its driver is stuck");
/// assert_eq!(camera.fault(900_000_000).unwrap(), "no image for 0.9 s");
/// ```
#[derive(Clone, Debug)]
pub struct CameraWatch {
    /// Of its last images.
    hashes: VecDeque<u64>,
    /// When the last image came. [ns]
    arrived_ns: u64,
    /// What is wrong with the last image.
    unfit: Option<&'static str>,
    /// Why there are none, until there is one again.
    ended: Option<String>,
}

impl CameraWatch {
    /// Begins when a source was opened. [ns]
    pub fn new(now_ns: u64) -> Self {
        Self { hashes: VecDeque::new(), arrived_ns: now_ns, unfit: None, ended: None }
    }

    /// Takes an image; returns whether it may be located by.
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

    /// Takes why there are no more images.
    pub fn handle_end(&mut self, why: String) {
        self.ended = Some(why);
    }

    /// Returns what is wrong now; `None` for a camera that is well.
    pub fn fault(&self, now_ns: u64) -> Option<String> {
        if let Some(why) = &self.ended {
            return Some(why.clone());
        }
        let silent_ns = now_ns.saturating_sub(self.arrived_ns);
        if silent_ns > SILENT_NS {
            // In tenths, so that it does not change with every look.
            return Some(format!("no image for {:.1} s", silent_ns as f64 / 1e9));
        }
        self.unfit.map(str::to_owned)
    }
}

/// Returns a number that two different images hardly share (a multiplicative hash of eight bytes at a time; 1280 x 720
/// take 0.1 ms).
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

/// A stuck driver hands out its buffers again, one or all of them in turn.
const MAX_HASHES: usize = 8;
/// The slowest camera takes 10 images a second; it is named within half a second. [ns]
const SILENT_NS: u64 = 350_000_000;
/// Where nothing is brighter no tag is read. [grey levels of 255]
const DARK: u8 = 24;
/// One pixel of so many is looked at: of rows whose length is no multiple of it, all columns.
const SAMPLED: usize = 61;

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(seed: u8) -> Gray {
        let pixels = (0..64 * 48u32).map(|i| (i as u8).wrapping_mul(7).wrapping_add(seed));
        Gray::new(64, 48, pixels.collect()).unwrap()
    }

    #[test]
    fn a_camera_that_comes_back_is_well_again() {
        let ms = 1_000_000;
        let mut camera = CameraWatch::new(0);
        let check = |camera: &CameraWatch, at_ms: u64, expected: Option<&str>| {
            assert_eq!(camera.fault(at_ms * ms).as_deref(), expected);
        };
        check(&camera, 100, None);
        check(&camera, 400, Some("no image for 0.4 s"));
        assert!(camera.handle_image(500 * ms, &picture(1)));
        check(&camera, 600, None);
        // Its buffers, again and again.
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
