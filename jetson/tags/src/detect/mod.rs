//! Detection of tags in an image, with subpixel corners.
//!
//! The input is a grey image. The output for each tag is its family, its number, and the corners of its black square.
//! Corners are in the order of the layout: with the tag upright, lower left, lower right, upper right, upper left.
//!
//! The C library finds and decodes the quads. [`Detector::search`] scans the whole image at reduced resolution;
//! [`Detector::look`] scans a region in which tags are expected, at full or doubled resolution. [`refine`] measures the
//! corners of large tags again, along edges that are straight behind the lens but curved in the image. Called once per
//! image and camera. The time is proportional to the pixels scanned: 2 ms for a tracked cube, 35 to 140 ms for a search
//! of 1280x720.

mod library;
mod refine;

use glam::DVec2;
use vizflyt_protocol::geometry::Intrinsics;

use crate::detection::Detection;
use crate::family::TagFamily;
use crate::image::Gray;
use library::Library;

/// Settings of the detector.
#[derive(Clone, Debug, PartialEq)]
pub struct DetectorSettings {
    /// Decimation of a search of the whole image: 1 is every pixel, 2 every other.
    pub search_decimate: f32,
    /// Maximum number of misread bits that are corrected, 0 to 2. Higher values cause false detections, for example in
    /// bushes.
    pub corrected_bits: u8,
    /// Amount of sharpening before cells are read; helps tags of few pixels.
    pub sharpening: f64,
    /// Minimum contrast; tags below it are rejected as random matches. [grey levels]
    pub least_margin: f64,
    /// In a region, the image is enlarged if the shortest edge of a tag is below this. [px]
    pub enlarge_below_px: f64,
}

impl Default for DetectorSettings {
    fn default() -> Self {
        Self {
            search_decimate: 2.0,
            corrected_bits: 1,
            sharpening: 0.25,
            least_margin: 15.0,
            enlarge_below_px: 30.0,
        }
    }
}

/// A rectangle of pixels. The part outside the image is cut off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    /// Minimum x and y. [px, image]
    pub least_px: DVec2,
    /// Maximum x and y. [px, image]
    pub most_px: DVec2,
    /// Expected length of the shortest edge of the tags in it, if known. [px]
    pub tag_edge_px: Option<f64>,
}

impl Region {
    /// Returns the pixels of the region within an image: x and y of the first pixel, width, and height.
    fn cut(&self, image: &Gray) -> Option<(usize, usize, usize, usize)> {
        let most = DVec2::new(f64::from(image.width_px()), f64::from(image.height_px()));
        let low = self.least_px.floor().clamp(DVec2::ZERO, most);
        let high = self.most_px.ceil().clamp(DVec2::ZERO, most);
        // Also false if a bound is NaN.
        (high.x > low.x && high.y > low.y).then(|| {
            let size = high - low;
            (low.x as usize, low.y as usize, size.x as usize, size.y as usize)
        })
    }
}

/// Finds tags of given families.
pub struct Detector {
    library: Library,
    settings: DetectorSettings,
}

impl Detector {
    pub fn new(families: &[TagFamily], settings: DetectorSettings) -> Self {
        Self { library: Library::new(families, &settings), settings }
    }

    /// Returns the tags in the whole image, with corners at full resolution. Scans every pixel if `fine`, otherwise at
    /// reduced resolution.
    pub fn search(&mut self, image: &Gray, camera: &Intrinsics, fine: bool) -> Vec<Detection> {
        let (width, height) = (image.width_px() as usize, image.height_px() as usize);
        let decimate = if fine { 1.0 } else { self.settings.search_decimate.clamp(1.0, 8.0) };
        let raw = self.library.detect(width, height, decimate, |pixels| {
            pixels.extend_from_slice(image.pixels());
        });
        self.finish(raw, image, camera)
    }

    /// Returns the tags in a region of the image. Scans every pixel, or an image enlarged by two if the tags are small.
    pub fn look(&mut self, image: &Gray, region: &Region, camera: &Intrinsics) -> Vec<Detection> {
        let Some((x, y, width, height)) = region.cut(image) else { return Vec::new() };
        // A large region full of tags, as a camera on the vehicle sees, takes long to enlarge. Some tags may be missed
        // there.
        let is_large = 4 * width * height > (image.width_px() * image.height_px()) as usize;
        let share = if is_large { LARGE_PART_SHARE } else { 1.0 };
        let small =
            region.tag_edge_px.is_some_and(|edge| edge < share * self.settings.enlarge_below_px);
        let shift = DVec2::new(x as f64, y as f64);
        let mut raw = if small {
            let mut raw = self.library.detect(2 * width, 2 * height, 1.0, |pixels| {
                enlarge(image, (x, y, width, height), pixels);
            });
            for tag in &mut raw {
                tag.corners_px = tag.corners_px.map(|corner| corner / 2.0);
            }
            raw
        } else {
            let decimate = match region.tag_edge_px {
                Some(edge) if edge > 2.0 * COARSE_ABOVE_PX => 4.0,
                Some(edge) if edge > COARSE_ABOVE_PX => 2.0,
                _ => 1.0,
            };
            self.library.detect(width, height, decimate, |pixels| {
                for row in y..y + height {
                    pixels.extend_from_slice(&row_of(image, row)[x..x + width]);
                }
            })
        };
        for tag in &mut raw {
            tag.corners_px = tag.corners_px.map(|corner| corner + shift);
        }
        self.finish(raw, image, camera)
    }

    fn finish(&self, raw: Vec<Detection>, image: &Gray, camera: &Intrinsics) -> Vec<Detection> {
        let mut found: Vec<Detection> = raw
            .into_iter()
            .filter(|tag| tag.margin >= self.settings.least_margin)
            .filter(|tag| shortest(&tag.corners_px) >= MIN_EDGE_PX)
            .filter(|tag| whole(&tag.corners_px, image))
            .map(|tag| {
                // Edges of a small tag do not bend, and the library measures them equally well.
                let large = shortest(&tag.corners_px) > REFINE_ABOVE_PX;
                let refined = large.then(|| refine::refine(image, camera, &tag.corners_px));
                Detection { corners_px: refined.flatten().unwrap_or(tag.corners_px), ..tag }
            })
            .collect();
        found.sort_by_key(|tag| (tag.family, tag.id));
        found
    }
}

/// Returns whether a tag and some of the white around it are inside the image. If the image's border cuts a tag, the
/// library takes the border for an edge and often still decodes the tag. Its corners are then off by many pixels.
fn whole(corners_px: &[DVec2; 4], image: &Gray) -> bool {
    let size = DVec2::new(f64::from(image.width_px()), f64::from(image.height_px()));
    let middle = corners_px.iter().sum::<DVec2>() / 4.0;
    corners_px.iter().all(|&corner| {
        let rim = middle + (corner - middle) * RIM;
        rim.cmpge(DVec2::ZERO).all() && rim.cmple(size).all()
    })
}

fn shortest(corners_px: &[DVec2; 4]) -> f64 {
    (0..4).map(|i| corners_px[i].distance(corners_px[(i + 1) % 4])).fold(f64::INFINITY, f64::min)
}

/// Returns row `y` from the top.
fn row_of(image: &Gray, y: usize) -> &[u8] {
    let width = image.width_px() as usize;
    &image.pixels()[y * width..][..width]
}

/// Writes a region of an image at twice the width and height, interpolated between pixel centres.
fn enlarge(
    image: &Gray,
    (x, y, width, height): (usize, usize, usize, usize),
    pixels: &mut Vec<u8>,
) {
    pixels.reserve(4 * width * height);
    for row in 0..2 * height {
        // Centres of the fine rows are a quarter of a pixel above and below those of the coarse rows.
        let near = row_of(image, y + row / 2);
        let other = if row % 2 == 0 {
            (y + row / 2).saturating_sub(1)
        } else {
            (y + row / 2 + 1).min(image.height_px() as usize - 1)
        };
        let far = row_of(image, other);
        let mixed = |at: usize| 3 * u16::from(near[at]) + u16::from(far[at]);
        for column in x..x + width {
            let here = mixed(column);
            let left = mixed(column.saturating_sub(1));
            let right = mixed((column + 1).min(image.width_px() as usize - 1));
            pixels.push(((3 * here + left + 8) / 16) as u8);
            pixels.push(((3 * here + right + 8) / 16) as u8);
        }
    }
}

/// In regions of more than a quarter of the image, the limit for enlarging is multiplied by this.
const LARGE_PART_SHARE: f64 = 0.6;
/// Scale of the corners that must be in the image: half a cell of white around eight cells, and a margin for
/// perspective.
const RIM: f64 = 1.15;
/// Smaller tags look like noise: a cell of 36h11 is then one pixel wide. [px]
const MIN_EDGE_PX: f64 = 8.0;
/// Above this edge length, corners refined through the lens are better than the library's: 0.05 px instead of 0.16 px
/// at 150 px behind the lens of a common webcam, equal at 75 px (`detect/tests.rs`). [px]
const REFINE_ABOVE_PX: f64 = 75.0;
/// Tags larger than this are found at half resolution in a quarter of the time, tags twice as large at a quarter. [px]
const COARSE_ABOVE_PX: f64 = 70.0;

#[cfg(test)]
mod tests;
