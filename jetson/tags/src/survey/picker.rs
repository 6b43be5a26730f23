//! Selection of a video's images for a survey.

use vizflyt_protocol::geometry::Intrinsics;

use crate::detection::Detection;

/// Keeps images that differ from the previously kept one. A video repeats the same view thirty times per second, and
/// the time of a survey grows with the number of images.
#[derive(Clone, Debug, Default)]
pub struct Picker {
    images: Vec<Vec<Detection>>,
}

impl Picker {
    /// Adds the tags of the next image if they differ enough.
    pub fn offer(&mut self, image: Vec<Detection>, lens: &Intrinsics) {
        if image.len() < 2 || self.is_full() {
            return;
        }
        let is_new = self.images.last().is_none_or(|last| {
            let mut moved_px: f64 = 0.0;
            let mut common = 0;
            for now in &image {
                let same = |old: &&Detection| (old.family, old.id) == (now.family, now.id);
                if let Some(old) = last.iter().find(same) {
                    common += 1;
                    moved_px = moved_px.max(old.corners_px[0].distance(now.corners_px[0]));
                }
            }
            common < image.len() || moved_px > MOVED * f64::from(lens.width_px)
        });
        if is_new {
            self.images.push(image);
        }
    }

    /// Returns the tags of the kept images.
    pub fn images(&self) -> &[Vec<Detection>] {
        &self.images
    }

    /// Returns whether the maximum number of images is reached.
    pub fn is_full(&self) -> bool {
        self.images.len() >= MAX_IMAGES
    }
}

/// Minimum motion of a tag. [share of the image's width]
const MOVED: f64 = 0.03;
/// Maximum number of images: a survey of a hundred tags then takes some seconds.
const MAX_IMAGES: usize = 300;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::family::TagFamily;
    use glam::DVec2;

    #[test]
    fn keeps_an_image_if_a_tag_moved_or_appeared() {
        let lens = Intrinsics::from_horizontal_fov(1000, 700, 1.2);
        let tag = |id: u32, x: f64| Detection {
            family: TagFamily::Tag36h11,
            id,
            corners_px: [DVec2::new(x, 0.0); 4],
            hamming: 0,
            margin: 50.0,
        };
        let mut picker = Picker::default();
        picker.offer(vec![tag(1, 0.0)], &lens);
        assert!(picker.images().is_empty(), "one tag does not connect images");
        picker.offer(vec![tag(1, 0.0), tag(2, 50.0)], &lens);
        picker.offer(vec![tag(1, 10.0), tag(2, 60.0)], &lens);
        assert_eq!(picker.images().len(), 1);
        picker.offer(vec![tag(1, 35.0), tag(2, 50.0)], &lens);
        assert_eq!(picker.images().len(), 2);
        picker.offer(vec![tag(1, 35.0), tag(3, 50.0)], &lens);
        assert_eq!(picker.images().len(), 3);
    }
}
