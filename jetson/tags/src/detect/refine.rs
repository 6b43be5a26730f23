//! Refines the corners of a tag from its four edges.
//!
//! Points are measured along each edge. Across the edge, brightness changes from the black of the border to the white
//! around it, and the edge is where the two areas balance. This is exact for any symmetric blur, including motion blur;
//! a search for the steepest gradient is sensitive to noise. The points are converted through the lens to slopes, where
//! edges are straight lines; the corners are the intersections of these lines. In the image, the edge of a near tag
//! behind a wide lens bends by pixels.

use glam::DVec2;
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use super::row_of;
use crate::image::Gray;

/// Returns the refined corners. `None` if an edge has too few good points, or if a corner would move further than the
/// search range.
pub(super) fn refine(
    image: &Gray,
    camera: &Intrinsics,
    corners_px: &[DVec2; 4],
) -> Option<[DVec2; 4]> {
    let mut slopes = [DVec2::ZERO; 4];
    for (slope, &corner) in slopes.iter_mut().zip(corners_px) {
        *slope = camera.slope(corner)?;
    }
    let centre = slopes.iter().sum::<DVec2>() / 4.0;
    let mut lines = [Line::default(); 4];
    let mut moved_px = 0.0f64;
    for i in 0..4 {
        lines[i] = edge(image, camera, slopes[i], slopes[(i + 1) % 4], centre)?;
        moved_px = moved_px.max(lines[i].reach_px);
    }
    let mut refined = [DVec2::ZERO; 4];
    for i in 0..4 {
        let slope = lines[(i + 3) % 4].crossing(&lines[i])?;
        let corner = project(camera, slope);
        if !(corner.distance(corners_px[i]) <= 2.0 * moved_px) {
            return None;
        }
        refined[i] = corner;
    }
    Some(refined)
}

/// A straight line in slopes, through `at` in direction `along`.
#[derive(Clone, Copy, Debug, Default)]
struct Line {
    at: DVec2,
    along: DVec2,
    /// Sum of the squared distances of the points. [px^2]
    sum_px2: f64,
    points: u32,
    /// Search range to each side of the expected edge. [px]
    reach_px: f64,
}

impl Line {
    fn crossing(&self, other: &Self) -> Option<DVec2> {
        let area = self.along.perp_dot(other.along);
        // Lines of a tag that is not seen edge-on intersect at a clear angle.
        (area.abs() > 0.05)
            .then(|| self.at + self.along * ((other.at - self.at).perp_dot(other.along) / area))
    }
}

fn edge(image: &Gray, camera: &Intrinsics, from: DVec2, to: DVec2, centre: DVec2) -> Option<Line> {
    let (from_px, to_px) = (project(camera, from), project(camera, to));
    let length_px = from_px.distance(to_px);
    // The width of a cell differs along and across this edge; the tag's centre gives the latter.
    let across_px = 2.0 * distance_px(camera, from, to, centre);
    // The black border and the white around it are one cell of eight each. Small families have fewer, larger cells.
    let reach_px = (REACH_CELLS * across_px / 8.0).clamp(MIN_REACH_PX, MAX_REACH_PX);
    let count = ((length_px / SPACING_PX) as usize).clamp(MIN_POINTS + 2, MAX_POINTS);
    // Neighbouring edges blur the ends.
    let end = (reach_px / length_px).max(0.06);
    if end > 0.3 {
        return None;
    }
    // The distortion is followed from point to point: a close start needs few Newton steps.
    let outward = {
        let middle = (from + to) / 2.0;
        let normal = (to - from).perp();
        if normal.dot(middle - centre) >= 0.0 { normal } else { -normal }
    };
    let mut profiles = Vec::with_capacity(count);
    for i in 0..count {
        let t = end + (1.0 - 2.0 * end) * (i as f64 + 0.5) / count as f64;
        let slope = from.lerp(to, t);
        let (distorted, jacobian) = camera.distortion.distort(slope);
        let px = pixel(camera, distorted);
        // The normal of a line in the image is not the image of the line's normal.
        let along_px = (jacobian * (to - from)) * DVec2::new(camera.fx_px, camera.fy_px);
        let side = (jacobian * outward) * DVec2::new(camera.fx_px, camera.fy_px);
        let normal = along_px.perp().normalize_or_zero();
        let normal = if normal.dot(side) >= 0.0 { normal } else { -normal };
        if let Some(profile) = profile(image, px, normal, reach_px) {
            profiles.push((slope, px, normal, profile));
        }
    }
    if profiles.len() < MIN_POINTS {
        return None;
    }
    // Black and white vary slowly along the edge: two straight lines are fitted to the ends of all profiles.
    let black = Trend::of(profiles.iter().map(|(_, _, _, p)| p.inner));
    let white = Trend::of(profiles.iter().map(|(_, _, _, p)| p.outer));
    let mut points: Vec<(DVec2, f64)> = Vec::with_capacity(profiles.len());
    for (i, (slope, px, normal, profile)) in profiles.iter().enumerate() {
        let (black, white) = (black.at(i), white.at(i));
        let contrast = white - black;
        if !(contrast.abs() >= MIN_CONTRAST) {
            continue;
        }
        // White share of the distance from -reach to reach.
        let share = (profile.mean - black) / contrast;
        let offset_px = reach_px * (1.0 - 2.0 * share);
        if offset_px.abs() <= 0.8 * reach_px {
            let at = *px + *normal * offset_px;
            points.push((slope_near(camera, at, *slope)?, 1.0));
        }
    }
    let mut line = fit(&points, camera, reach_px)?;
    // Fit again without outliers: a cable in front of the edge, or a highlight.
    let rms_px = (line.sum_px2 / f64::from(line.points)).sqrt();
    let limit_px = (2.5 * rms_px).max(0.1);
    for (slope, weight) in &mut points {
        if line_distance_px(camera, &line, *slope) > limit_px {
            *weight = 0.0;
        }
    }
    line = fit(&points, camera, reach_px)?;
    Some(line)
}

/// Brightness across an edge.
struct Profile {
    /// Brightness at the inner end. [grey levels]
    inner: f64,
    /// Brightness at the outer end. [grey levels]
    outer: f64,
    /// Mean brightness. [grey levels]
    mean: f64,
}

fn profile(image: &Gray, px: DVec2, normal: DVec2, reach_px: f64) -> Option<Profile> {
    let steps = (reach_px / STEP_PX).round().max(2.0) as i32;
    let step_px = reach_px / f64::from(steps);
    let (mut sum, mut inner, mut outer) = (0.0, 0.0, 0.0);
    for k in -steps..=steps {
        let value = sample(image, px + normal * (f64::from(k) * step_px))?;
        // Trapezoidal rule: both ends have half weight.
        if k == -steps {
            inner = value;
            sum += 0.5 * value;
        } else if k == steps {
            outer = value;
            sum += 0.5 * value;
        } else {
            sum += value;
        }
    }
    Some(Profile { inner, outer, mean: sum / f64::from(2 * steps) })
}

/// Returns the brightness interpolated between pixel centres, or `None` outside the image.
fn sample(image: &Gray, px: DVec2) -> Option<f64> {
    let at = px - 0.5;
    let (x, y) = (at.x.floor(), at.y.floor());
    let inside = x >= 0.0
        && y >= 0.0
        && x + 1.0 < f64::from(image.width_px())
        && y + 1.0 < f64::from(image.height_px());
    if !inside {
        return None;
    }
    let (u, v) = (at.x - x, at.y - y);
    let (x, y) = (x as usize, y as usize);
    let (upper, lower) = (row_of(image, y), row_of(image, y + 1));
    let mix = |row: &[u8]| f64::from(row[x]) * (1.0 - u) + f64::from(row[x + 1]) * u;
    Some(mix(upper) * (1.0 - v) + mix(lower) * v)
}

/// Straight line through equally spaced values, by least squares.
struct Trend {
    mean: f64,
    slope: f64,
    middle: f64,
}

impl Trend {
    fn of(values: impl ExactSizeIterator<Item = f64> + Clone) -> Self {
        let n = values.len() as f64;
        let middle = (n - 1.0) / 2.0;
        let mean = values.clone().sum::<f64>() / n;
        let (mut xy, mut xx) = (0.0, 0.0);
        for (i, value) in values.enumerate() {
            let x = i as f64 - middle;
            xy += x * (value - mean);
            xx += x * x;
        }
        Self { mean, slope: if xx > 0.0 { xy / xx } else { 0.0 }, middle }
    }

    fn at(&self, i: usize) -> f64 {
        self.mean + self.slope * (i as f64 - self.middle)
    }
}

fn fit(points: &[(DVec2, f64)], camera: &Intrinsics, reach_px: f64) -> Option<Line> {
    let total: f64 = points.iter().map(|(_, w)| w).sum();
    if !(total >= MIN_POINTS as f64) {
        return None;
    }
    let at = points.iter().map(|&(p, w)| p * w).sum::<DVec2>() / total;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for &(p, w) in points {
        let d = p - at;
        xx += w * d.x * d.x;
        xy += w * d.x * d.y;
        yy += w * d.y * d.y;
    }
    // Direction of the largest spread of a symmetric 2 x 2 matrix.
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let mut line = Line { at, along: DVec2::from_angle(angle), sum_px2: 0.0, points: 0, reach_px };
    for &(p, w) in points {
        if w > 0.0 {
            let off = line_distance_px(camera, &line, p);
            line.sum_px2 += off * off;
            line.points += 1;
        }
    }
    Some(line)
}

fn line_distance_px(camera: &Intrinsics, line: &Line, slope: DVec2) -> f64 {
    let off = line.along.perp_dot(slope - line.at);
    (off * line.along.perp() * DVec2::new(camera.fx_px, camera.fy_px)).length()
}

/// Returns the distance of `centre` from the line through two slopes. [px]
fn distance_px(camera: &Intrinsics, from: DVec2, to: DVec2, centre: DVec2) -> f64 {
    let (a, b, c) = (project(camera, from), project(camera, to), project(camera, centre));
    (b - a).normalize_or_zero().perp_dot(c - a).abs()
}

fn pixel(camera: &Intrinsics, distorted: DVec2) -> DVec2 {
    DVec2::new(camera.fx_px, camera.fy_px) * distorted + DVec2::new(camera.cx_px, camera.cy_px)
}

fn project(camera: &Intrinsics, slope: DVec2) -> DVec2 {
    pixel(camera, camera.distortion.distort(slope).0)
}

/// Returns the slope of a pixel near a known slope. Uses a few Newton steps instead of the search of
/// [`Intrinsics::slope`].
fn slope_near(camera: &Intrinsics, px: DVec2, near: DVec2) -> Option<DVec2> {
    let centre = DVec2::new(camera.cx_px, camera.cy_px);
    let wanted = (px - centre) / DVec2::new(camera.fx_px, camera.fy_px);
    if camera.distortion == Distortion::None {
        return Some(wanted);
    }
    let mut slope = near;
    for _ in 0..3 {
        let (found, jacobian) = camera.distortion.distort(slope);
        slope += jacobian.inverse() * (wanted - found);
    }
    slope.is_finite().then_some(slope)
}

/// Search range across an edge, as a share of a cell. Within one cell on both sides the colour is constant.
const REACH_CELLS: f64 = 0.6;
/// A smaller range would be within the blur of the sharpest lens. [px]
const MIN_REACH_PX: f64 = 1.5;
/// A larger range would include uneven light and cost time. [px]
const MAX_REACH_PX: f64 = 5.0;
/// Spacing of samples across an edge. [px]
const STEP_PX: f64 = 0.5;
/// Spacing of points along an edge. Closer points would use the same pixels. [px]
const SPACING_PX: f64 = 1.0;
/// Minimum number of points for a line.
const MIN_POINTS: usize = 5;
/// More points cost time without a gain in accuracy.
const MAX_POINTS: usize = 64;
/// A smaller contrast between black and white is noise. [grey levels]
const MIN_CONTRAST: f64 = 12.0;
