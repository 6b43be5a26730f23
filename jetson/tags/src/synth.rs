//! Renders images of tags with known ground truth, for tests, benchmarks and the simulated lab.
//!
//! ```text
//! Renderer::new(intrinsics)             slope of the ray through every pixel, once per lens
//! Renderer::render(&SyntheticExposure)  per tag and pixel: samples over the pixel, the optical blur and
//!                                       the exposure time, all at once; then light, then noise
//! ```
//!
//! A sample is a position in the pixel's footprint (the box of the pixel, spread by the blur) and an instant of the
//! exposure. A homography maps its ray to the tag's plane. So optical blur and motion blur cost no more than
//! antialiasing. The result depends only on the exposure and its seed.
//!
//! Cost: 16 samples for a pixel with an edge between cells, one for a pixel of one colour, fewer for large areas of one
//! colour (`docs/BENCHMARKS.md`, "drawing").

pub mod ink;
mod pattern;
mod rays;

use std::collections::HashMap;
use std::sync::Mutex;

use glam::{DMat2, DMat3, DVec2, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Frame, Intrinsics, Pose, World};

use crate::family::{Cells, TagFamily};
use crate::image::Gray;
use crate::layout::{LayoutFrame, Square, Tag, TagLayout};
use pattern::Pattern;
pub(crate) use pattern::Random;
use rays::Rays;

/// Frame of a layout, body or world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {}

impl Frame for Layout {
    const NAME: &'static str = "layout";
}

/// A layout with its poses during the exposure.
#[derive(Clone, Copy, Debug)]
pub struct Placed<'a> {
    layout: &'a TagLayout,
    /// Poses at the beginning and at the end of the exposure.
    world_from_layout: [Pose<World, Layout>; 2],
}

impl<'a> Placed<'a> {
    /// Places a mat or wall with tags in the `world` frame.
    ///
    /// # Panics
    /// If the layout is in the body frame.
    pub fn fixed(layout: &'a TagLayout) -> Self {
        assert_eq!(layout.frame, LayoutFrame::World, "this layout needs a vehicle's pose");
        Self { layout, world_from_layout: [Pose::IDENTITY; 2] }
    }

    /// Places a cube on a vehicle, with the vehicle's poses at the beginning and the end of the exposure.
    ///
    /// # Panics
    /// If the layout is in the world frame.
    pub fn on_vehicle(layout: &'a TagLayout, world_from_body: [Pose<World, Body>; 2]) -> Self {
        assert_eq!(layout.frame, LayoutFrame::Body, "this layout is fixed in the room");
        let pose = |p: Pose<World, Body>| Pose::new(p.translation_m, p.rotation);
        Self { layout, world_from_layout: world_from_body.map(pose) }
    }

    /// Places a layout at any pose, for calibration boards that are moved in front of a camera.
    pub fn anywhere(layout: &'a TagLayout, world_from_layout: Pose<World, Layout>) -> Self {
        Self { layout, world_from_layout: [world_from_layout; 2] }
    }

    /// Returns the positions of the tags' middles at the beginning of the exposure. [m, world]
    pub(crate) fn middles_m(&self) -> impl Iterator<Item = DVec3> {
        self.layout.tags.iter().map(|tag| self.world_from_layout[0].transform_point(tag.position_m))
    }
}

/// Lighting of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Light {
    /// Brightness of black ink in full light. [grey levels of 255]
    pub black: f64,
    /// Brightness of white paper in full light. [grey levels of 255]
    pub white: f64,
    /// Relative increase in brightness from the image's left edge to its right, and from its upper edge to its lower;
    /// 0.5 is from 75 % to 125 %.
    pub gradient: DVec2,
    /// Relative decrease in brightness from the middle to the corners; 0.3 leaves 70 %.
    pub vignette: f64,
}

impl Default for Light {
    fn default() -> Self {
        Self { black: 30.0, white: 205.0, gradient: DVec2::ZERO, vignette: 0.0 }
    }
}

/// One synthetic exposure.
#[derive(Clone, Copy, Debug)]
pub struct SyntheticExposure<'a> {
    /// Visible layouts.
    pub placed: &'a [Placed<'a>],
    /// Camera poses at the beginning and at the end of the exposure.
    pub world_from_cam: [Pose<World, Cam>; 2],
    /// Background behind the tags, in the image's size; `None` is a cluttered grey wall.
    pub background: Option<&'a Gray>,
    /// Lighting of the scene.
    pub light: Light,
    /// Standard deviation of the optical blur. [px]
    pub blur_px: f64,
    /// Standard deviation of the sensor noise. [grey levels of 255]
    pub noise: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl<'a> SyntheticExposure<'a> {
    /// Returns a sharp exposure without motion and noise, in even light.
    pub fn still(placed: &'a [Placed<'a>], world_from_cam: Pose<World, Cam>) -> Self {
        Self {
            placed,
            world_from_cam: [world_from_cam; 2],
            background: None,
            light: Light::default(),
            blur_px: 0.0,
            noise: 0.0,
            seed: 0,
        }
    }
}

/// Renderer for one lens.
#[derive(Debug)]
pub struct Renderer {
    intrinsics: Intrinsics,
    rays: Rays,
    /// Default background, as a share of white.
    wall: Vec<f32>,
    /// Table of standard normal numbers; each row of an image uses a part of it.
    normal: Vec<f32>,
    cells: Mutex<HashMap<(TagFamily, u32), Cells>>,
}

impl Renderer {
    /// Computes the rays of all pixels.
    pub fn new(intrinsics: Intrinsics) -> Self {
        let mut random = Random::new(0x7469_6c65);
        Self {
            intrinsics,
            rays: Rays::new(&intrinsics),
            wall: clutter(&intrinsics),
            normal: (0..NORMALS).map(|_| random.normal() as f32).collect(),
            cells: Mutex::default(),
        }
    }

    /// Returns the lens of the renderer.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Renders one exposure.
    ///
    /// # Panics
    /// If the background does not have the size of the image.
    pub fn render(&self, shot: &SyntheticExposure<'_>) -> Gray {
        // Brightness in even light: 0 is black ink, 1 white paper.
        let mut albedo = match shot.background {
            None => self.wall.clone(),
            Some(image) => {
                let size = (image.width_px(), image.height_px());
                assert_eq!(size, (self.intrinsics.width_px, self.intrinsics.height_px));
                let span = shot.light.white - shot.light.black;
                let grey = |&p: &u8| ((f64::from(p) - shot.light.black) / span) as f32;
                image.pixels().iter().map(grey).collect()
            }
        };
        let pattern = Pattern::new(SAMPLES, shot.blur_px);
        for (quad, tag) in Self::farthest_first(shot) {
            self.render_tag(&mut albedo, &pattern, &quad, &tag);
        }
        self.expose(&albedo, shot)
    }

    /// Returns the tags that face the camera, the farthest first.
    fn farthest_first(shot: &SyntheticExposure<'_>) -> Vec<([DMat3; 2], Tag)> {
        let mut quads = Vec::new();
        for placed in shot.placed {
            for tag in &placed.layout.tags {
                let cam_from_tag = |t: f64| -> Pose<Cam, Square> {
                    let world_from_cam =
                        shot.world_from_cam[0].interpolate(&shot.world_from_cam[1], t);
                    let [begin, end] = &placed.world_from_layout;
                    let layout_from_tag: Pose<Layout, Square> = tag.frame_from_tag();
                    world_from_cam.inverse() * begin.interpolate(end, t) * layout_from_tag
                };
                let middle = cam_from_tag(0.5);
                // The printed face is visible from the side that its normal points to.
                let faces = middle.rotate(DVec3::Z).dot(middle.translation_m) < 0.0;
                let ahead = crate::layout::CORNERS.iter().all(|c| {
                    middle.transform_point((*c * 2.0 * tag.size_m).extend(0.0)).z > NEAR_M
                });
                if faces && ahead {
                    let tag_from_slope =
                        [0.0, 1.0].map(|t| homography(cam_from_tag(t), tag.size_m));
                    quads.push((middle.translation_m.length(), tag_from_slope, *tag));
                }
            }
        }
        quads.sort_by(|a: &(f64, [DMat3; 2], Tag), b| b.0.total_cmp(&a.0));
        quads.into_iter().map(|(_, quad, tag)| (quad, tag)).collect()
    }

    fn render_tag(
        &self,
        albedo: &mut [f32],
        pattern: &Pattern,
        tag_from_slope: &[DMat3; 2],
        tag: &Tag,
    ) {
        let mut kept = self.cells.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let cells = match kept.entry((tag.family, tag.id)) {
            std::collections::hash_map::Entry::Occupied(entry) => entry.into_mut(),
            std::collections::hash_map::Entry::Vacant(entry) => {
                let Some(cells) = tag.family.cells(tag.id) else { return };
                entry.insert(cells)
            }
        };
        let paper = paper_edge(cells);
        let Some([left, top, right, bottom]) = self.bounds(tag_from_slope, paper, pattern) else {
            return;
        };
        let (border, half) = (f64::from(cells.border()), f64::from(cells.across()) / 2.0);
        let across = cells.across() as i32;
        let spots = |x: u32, y: u32| -> Option<[Spot; 2]> {
            let (slope, per_px) = self.rays.at(x, y)?;
            let [begin, end] = tag_from_slope.each_ref();
            Some([Spot::at(begin, slope, per_px)?, Spot::at(end, slope, per_px)?])
        };
        // Large areas of a tag, and most of its pixels, have a single colour.
        let plain = |spots: &[Spot; 2], around_px: f64| {
            let [begin, end] =
                spots.each_ref().map(|spot| spot.reach(pattern.reach_px + around_px));
            colour(cells, begin.0.min(end.0), begin.1.max(end.1), paper).map(f32::from)
        };
        let width = self.intrinsics.width_px;
        for (x, y) in (top..bottom)
            .step_by(BLOCK_PX as usize)
            .flat_map(|y| (left..right).step_by(BLOCK_PX as usize).map(move |x| (x, y)))
        {
            let (x_end, y_end) = ((x + BLOCK_PX).min(right), (y + BLOCK_PX).min(bottom));
            let middle = spots(x + (x_end - x) / 2, y + (y_end - y) / 2);
            let block = middle.and_then(|spots| plain(&spots, f64::from(BLOCK_PX) / 2.0));
            for (x, y) in (y..y_end).flat_map(|y| (x..x_end).map(move |x| (x, y))) {
                let pixel = &mut albedo[(y * width + x) as usize];
                if let Some(shade) = block {
                    *pixel = shade;
                    continue;
                }
                // Behind the camera, so not on the paper.
                let Some(spots) = spots(x, y) else { continue };
                if let Some(shade) = plain(&spots, 0.0) {
                    *pixel = shade;
                    continue;
                }
                let [begin, end] = spots;
                let moved = end.at - begin.at;
                let (mut sum, mut covered) = (0u32, 0u32);
                for (offset, instant) in pattern.offsets_px.iter().zip(&pattern.instants) {
                    let at = begin.at + moved * *instant + begin.by_px * *offset;
                    if !(at.x.abs() < paper && at.y.abs() < paper) {
                        continue;
                    }
                    covered += 1;
                    // Columns increase to the right, rows downwards; y of the tag points up.
                    let column = (at.x * border + half).floor() as i32;
                    let row = (half - at.y * border).floor() as i32;
                    let inside = (0..across).contains(&column) && (0..across).contains(&row);
                    sum += u32::from(!inside || cells.is_white(column as u32, row as u32));
                }
                if covered > 0 {
                    let rest = SAMPLES as f32 - covered as f32;
                    *pixel = (sum as f32 + rest * *pixel) / SAMPLES as f32;
                }
            }
        }
    }

    /// Returns the pixel bounds of a paper: left, top, right, bottom; the last two are exclusive.
    fn bounds(
        &self,
        tag_from_slope: &[DMat3; 2],
        paper: f64,
        pattern: &Pattern,
    ) -> Option<[u32; 4]> {
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for tag_from_slope in tag_from_slope {
            let slope_from_tag = tag_from_slope.inverse();
            for step in 0..=OUTLINE {
                let along = paper * (2.0 * f64::from(step) / f64::from(OUTLINE) - 1.0);
                for at in [
                    DVec2::new(along, -paper),
                    DVec2::new(along, paper),
                    DVec2::new(-paper, along),
                    DVec2::new(paper, along),
                ] {
                    let p = slope_from_tag * at.extend(1.0);
                    if let Some(pixel) = self.rays.pixel(p.truncate() / p.z, &self.intrinsics) {
                        low = low.min(pixel);
                        high = high.max(pixel);
                    }
                }
            }
        }
        let size = DVec2::new(self.intrinsics.width_px.into(), self.intrinsics.height_px.into());
        let spread = DVec2::splat(pattern.reach_px + 2.0);
        let low = (low - spread).floor().clamp(DVec2::ZERO, size);
        let high = (high + spread).ceil().clamp(DVec2::ZERO, size);
        (low.x < high.x && low.y < high.y).then_some([
            low.x as u32,
            low.y as u32,
            high.x as u32,
            high.y as u32,
        ])
    }

    /// Converts brightness to the sensor's grey levels.
    fn expose(&self, albedo: &[f32], shot: &SyntheticExposure<'_>) -> Gray {
        let (width, height) = (self.intrinsics.width_px, self.intrinsics.height_px);
        let mut image = Gray::plain(width, height, 0);
        let mut random = Random::new(shot.seed);
        let Light { black, white, gradient, vignette } = shot.light;
        let (black, span) = (black as f32, (white - black) as f32);
        let noise = shot.noise as f32;
        // From -1/2 to 1/2 over the image.
        let across = |i: usize, n: u32| ((i as f64 + 0.5) / f64::from(n) - 0.5) as f32;
        let columns: Vec<f32> = (0..width as usize).map(|x| across(x, width)).collect();
        let (right, down, vignette) = (gradient.x as f32, gradient.y as f32, vignette as f32);
        let width = width as usize;
        for (y, row) in image.pixels_mut().chunks_exact_mut(width.max(1)).enumerate() {
            let v = across(y, height);
            let albedo = &albedo[y * width..][..width];
            // A row's noise is a contiguous part of the table: without index wrapping, the loop is vectorised.
            let from = random.next() as usize % (NORMALS - width);
            let normal = &self.normal[from..][..width];
            for x in 0..width {
                let u = columns[x];
                // In the corners, brightness is reduced by the full vignette.
                let fall = 2.0 * (u * u + v * v);
                let gain = (1.0 + right * u + down * v) * (1.0 - vignette * fall);
                let grey = (black + span * albedo[x]) * gain + noise * normal[x];
                // The conversion saturates, as a sensor does.
                row[x] = (grey + 0.5) as u8;
            }
        }
        image
    }
}

/// Returns half the edge of the paper, in edges of the black square.
fn paper_edge(cells: &Cells) -> f64 {
    (f64::from(cells.across()) / 2.0 + PAPER_CELLS) / f64::from(cells.border())
}

/// Returns the matrix that maps a slope in `cam` to a position on the tag, in edges of its black square. The third
/// component is positive in front of the camera.
fn homography(cam_from_tag: Pose<Cam, Square>, size_m: f64) -> DMat3 {
    let axes = DMat3::from_quat(cam_from_tag.rotation);
    let cam_from_plane =
        DMat3::from_cols(axes.x_axis * size_m, axes.y_axis * size_m, cam_from_tag.translation_m);
    cam_from_plane.inverse()
}

/// Intersection of a pixel's ray with a tag's plane at an instant, to first order in pixels. In a footprint of some
/// pixels, the error is below a hundredth of a pixel.
#[derive(Clone, Copy)]
struct Spot {
    /// Intersection for the pixel's middle. [edges of the black square]
    at: DVec2,
    /// Derivative by a step of one pixel right or down.
    by_px: DMat2,
}

impl Spot {
    /// Returns `None` behind the camera.
    fn at(tag_from_slope: &DMat3, slope: DVec2, per_px: DMat2) -> Option<Self> {
        let p = *tag_from_slope * slope.extend(1.0);
        if !(p.z > 0.0) {
            return None;
        }
        let at = p.truncate() / p.z;
        let by_slope = |column: DVec3| (column.truncate() - at * column.z) / p.z;
        let axes = [tag_from_slope.x_axis, tag_from_slope.y_axis].map(by_slope);
        Some(Self { at, by_px: DMat2::from_cols(axes[0], axes[1]) * per_px })
    }

    /// Returns the bounds of the area within `around_px` of the pixel.
    fn reach(&self, around_px: f64) -> (DVec2, DVec2) {
        let reach = (self.by_px.x_axis.abs() + self.by_px.y_axis.abs()) * around_px;
        (self.at - reach, self.at + reach)
    }
}

/// Returns whether all cells between two positions of a tag, in edges of its black square, are white (`true`) or black.
/// `None` if both colours occur, or if the paper, of half the edge `paper`, ends there.
fn colour(cells: &Cells, low: DVec2, high: DVec2, paper: f64) -> Option<bool> {
    if low.abs().max(high.abs()).max_element() > paper {
        return None;
    }
    let (border, half) = (f64::from(cells.border()), f64::from(cells.across()) / 2.0);
    let columns = [low.x, high.x].map(|x| (x * border + half).floor() as i32);
    let rows = [high.y, low.y].map(|y| (half - y * border).floor() as i32);
    // A pixel that covers many cells contains both colours.
    if columns[1] - columns[0] > 1 || rows[1] - rows[0] > 1 {
        return None;
    }
    let across = 0..cells.across() as i32;
    let is_white = |column: i32, row: i32| {
        !(across.contains(&column) && across.contains(&row))
            || cells.is_white(column as u32, row as u32)
    };
    let first = is_white(columns[0], rows[0]);
    let is_one = is_white(columns[1], rows[0]) == first
        && is_white(columns[0], rows[1]) == first
        && is_white(columns[1], rows[1]) == first;
    is_one.then_some(first)
}

/// Returns a grey wall with shades and boxes that contains no tag.
fn clutter(intrinsics: &Intrinsics) -> Vec<f32> {
    let (width, height) = (intrinsics.width_px, intrinsics.height_px);
    let mut random = Random::new(0x7761_6c6c);
    let mut wall = vec![0f32; intrinsics.pixels()];
    for y in 0..height {
        for x in 0..width {
            let (u, v) = (f64::from(x) / f64::from(width), f64::from(y) / f64::from(width));
            let shade = 0.45 + 0.1 * (5.0 * u + 2.0).sin() * (7.0 * v + 1.0).cos();
            wall[(y * width + x) as usize] = shade as f32;
        }
    }
    for _ in 0..BOXES {
        let mut side = |most: u32| (random.unit() * f64::from(most)) as u32;
        let (left, top) = (side(width), side(height));
        let (right, bottom) = (left + 2 + side(width / 8), top + 2 + side(height / 8));
        let shade = (0.15 + 0.6 * random.unit()) as f32;
        for y in top..bottom.min(height) {
            for x in left..right.min(width) {
                wall[(y * width + x) as usize] = shade;
            }
        }
    }
    wall
}

/// Samples per pixel: edges along the image's axes are then accurate to 1/32 px.
const SAMPLES: usize = 16;
/// Edge of the blocks that are first tested for a single colour. [px]
const BLOCK_PX: u32 = 4;
/// Number of segments of each paper edge for its bounds: a lens bends edges.
const OUTLINE: u32 = 8;
/// White margin around the printed cells. [cells]
const PAPER_CELLS: f64 = 0.5;
/// Minimum distance of a rendered tag. [m]
const NEAR_M: f64 = 0.02;
/// Number of boxes on the wall.
const BOXES: usize = 40;
/// Size of the noise table; a row starts at any index.
const NORMALS: usize = 1 << 16;

/// A webcam of 1280x720 with the lens used in tests.
#[cfg(test)]
pub(crate) fn webcam() -> Intrinsics {
    use vizflyt_protocol::geometry::Distortion;

    Intrinsics {
        distortion: Distortion::BrownConrady {
            k1: -0.12,
            k2: 0.03,
            p1: 0.001,
            p2: -0.0005,
            k3: 0.0,
        },
        ..Intrinsics::from_horizontal_fov(1280, 720, 1.2)
    }
}

#[cfg(test)]
mod tests;
