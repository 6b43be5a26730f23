//! Pass 1: projects Gaussians onto the image plane, and propagates derivatives from there back to their parameters.
//!
//! The mathematics is that of `vizflyt-splat` (Kerbl et al. 2023, with the linearisation clamped outside the image).
//! Alpha at `(x, y)` is `2^(level - falloff_x (dx - shear dy)^2 - falloff_y dy^2)`: this form cannot become negative,
//! and its determinant is computed from minors, so it cannot cancel. [`Flat::backward`] is the derivative of
//! [`Flat::of`], line by line from the end.
//!
//! Budget: about 60 ns per Gaussian in front of the camera, and 150 ns for its derivative.

use glam::{Mat3, Quat, Vec3};
use vizflyt_splat::harmonics::{C0, C1, C2, C3};
use vizflyt_splat::limits::{BLUR_PX2, MAX_SCALE_M};

use crate::gaussians::{coefficients, column};
use crate::view::View;

/// log2(1/255): minimum visible level.
pub(crate) const MIN_LEVEL: f32 = -7.994_353_5;
const HALF_LOG2_E: f32 = std::f32::consts::LOG2_E / 2.0;
const BLUR: f32 = BLUR_PX2 as f32;
/// Square of the minimum opacity factor of Gaussians much smaller than a pixel (anti-aliased).
const MIN_COMPENSATION2: f32 = 1e-8;

/// Rendering options.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Style {
    /// Degree of the harmonics used; at most that of the rows.
    pub degree: u8,
    /// Dims Gaussians that are blurred to the size of a pixel by the same factor (Yu et al. 2024, "Mip-Splatting",
    /// equation 11).
    pub antialiased: bool,
}

/// A Gaussian projected onto the image plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Flat {
    pub(crate) mean: [f32; 2],
    pub(crate) shear: f32,
    pub(crate) falloff: [f32; 2],
    /// log2 of the opacity.
    pub(crate) level: f32,
    /// Half size of the bounding box of alpha >= 1/255. [px]
    pub(crate) extent: [f32; 2],
    /// dy of the rightmost point of that ellipse. [px]
    pub(crate) tip_y: f32,
    pub(crate) z: f32,
    pub(crate) rgb: [f32; 3],
    /// Index of the row.
    pub(crate) index: u32,
}

/// Derivative of a loss by the fields of a [`Flat`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct FlatGradient {
    pub(crate) mean: [f32; 2],
    pub(crate) shear: f32,
    pub(crate) falloff: [f32; 2],
    pub(crate) level: f32,
    pub(crate) z: f32,
    pub(crate) rgb: [f32; 3],
}

/// Derivative of a loss by a row: geometry; harmonics as the product of `basis` and `rgb`.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RowGradient {
    pub(crate) geometry: [f32; column::SH],
    pub(crate) basis: [f32; 16],
    pub(crate) rgb: [f32; 3],
    /// Image error seen through the Gaussian. Not a derivative: it shows where more Gaussians are needed.
    pub(crate) error: f32,
}

/// Values that both directions compute.
struct Projection {
    /// Offset from the camera in world axes, and its depth.
    d: Vec3,
    z: f32,
    /// Slopes, and the slopes at which the projection is linearised.
    slope: [f32; 2],
    at: [f32; 2],
    /// Rows of J W.
    g: [Vec3; 2],
    rotation: Mat3,
    scales: Vec3,
    /// Rows of J W R S.
    u: Vec3,
    v: Vec3,
    /// Covariance on the image plane, without the blur.
    uu: f32,
    b: f32,
    vv: f32,
    /// Determinant of the covariance without and with blur.
    bare: f32,
    determinant: f32,
}

impl Projection {
    #[inline(always)]
    fn of(row: &[f32], view: &View) -> Option<Self> {
        let d = Vec3::from_slice(&row[column::MEAN..]) - view.position;
        let z = view.rows[2].dot(d);
        if !(z > view.near) {
            return None;
        }
        let slope = [view.rows[0].dot(d) / z, view.rows[1].dot(d) / z];
        let at: [f32; 2] =
            std::array::from_fn(|k| slope[k].max(view.slopes[k][0]).min(view.slopes[k][1]));
        let g =
            std::array::from_fn(|k| (view.rows[k] - view.rows[2] * at[k]) * (view.focal[k] / z));
        let rotation = Mat3::from_quat(Quat::from_slice(&row[column::ROTATION..]).normalize());
        let log = &row[column::LOG_SCALE..];
        let scales =
            Vec3::new(log[0].exp(), log[1].exp(), log[2].exp()).min(Vec3::splat(MAX_SCALE_M));
        let across = |g: Vec3| {
            scales
                * Vec3::new(rotation.x_axis.dot(g), rotation.y_axis.dot(g), rotation.z_axis.dot(g))
        };
        let (u, v) = (across(g[0]), across(g[1]));
        let (uu, b, vv) = (u.dot(u), u.dot(v), v.dot(v));
        let bare = u.cross(v).length_squared();
        let determinant = bare + BLUR * (uu + vv) + BLUR * BLUR;
        Some(Self { d, z, slope, at, g, rotation, scales, u, v, uu, b, vv, bare, determinant })
    }
}

impl Flat {
    /// Projects row `index`; returns `None` if the view does not see it.
    #[inline(always)]
    pub(crate) fn of(row: &[f32], index: u32, view: &View, style: Style) -> Option<Self> {
        let p = Projection::of(row, view)?;
        let (a, c) = (p.uu + BLUR, p.vv + BLUR);
        let mut level = -(1.0 + (-row[column::LOGIT]).exp()).log2();
        if style.antialiased {
            level += 0.5 * (p.bare / p.determinant).max(MIN_COMPENSATION2).log2();
        }
        let reach2 = (level - MIN_LEVEL) * (2.0 * std::f32::consts::LN_2);
        let extent = [(reach2 * a).sqrt(), (reach2 * c).sqrt()];
        let mean: [f32; 2] = std::array::from_fn(|k| view.focal[k] * p.slope[k] + view.center[k]);
        let size = [view.width as f32, view.height as f32];
        // Positive condition, so that NaN counts as unseen: some pixel's centre lies in the box.
        let seen = |k: usize| {
            mean[k] + extent[k] > 0.5 && mean[k] - extent[k] < size[k] - 0.5 && extent[k] < 1e18
        };
        if !(seen(0) && seen(1)) {
            return None;
        }
        let direction = p.d / p.d.length();
        let basis = basis(direction, style.degree);
        let sums = colour(&row[column::SH..], &basis, style.degree);
        Some(Self {
            mean,
            shear: p.b / c,
            falloff: [HALF_LOG2_E * c / p.determinant, HALF_LOG2_E / c],
            level,
            extent,
            tip_y: p.b * extent[0] / a,
            z: p.z,
            rgb: sums.map(|v| v.max(0.0)),
            index,
        })
    }

    /// Returns the derivative by the row's values from that on the image plane.
    #[inline(always)]
    pub(crate) fn backward(
        row: &[f32],
        view: &View,
        style: Style,
        by: &FlatGradient,
    ) -> RowGradient {
        let Some(p) = Projection::of(row, view) else { return RowGradient::default() };
        let (a, c) = (p.uu + BLUR, p.vv + BLUR);
        let det = p.determinant;
        let mut out = RowGradient::default();

        // Opacity: level = log2 sigmoid(logit).
        let opacity = 1.0 / (1.0 + (-row[column::LOGIT]).exp());
        out.geometry[column::LOGIT] = by.level * std::f32::consts::LOG2_E * (1.0 - opacity);

        // The ellipse: shear = b / c, falloff = h (c / det, 1 / c), det = a c - b^2.
        let across = HALF_LOG2_E / det * by.falloff[0];
        let (c_det, b_det) = (c / det, p.b / det);
        let mut by_a = -across * c * c_det;
        let mut by_b = by.shear / c + 2.0 * across * c * b_det;
        let mut by_c =
            -across * p.b * b_det - (p.b / c * by.shear + HALF_LOG2_E / c * by.falloff[1]) / c;
        if style.antialiased && p.bare > MIN_COMPENSATION2 * det {
            // level += log2(bare / det) / 2.
            let half = by.level * HALF_LOG2_E;
            by_a += half * (p.vv / p.bare - c_det);
            by_b += half * -2.0 * (p.b / p.bare - b_det);
            by_c += half * (p.uu / p.bare - a / det);
        }
        let by_u = p.u * (2.0 * by_a) + p.v * by_b;
        let by_v = p.v * (2.0 * by_c) + p.u * by_b;

        // u = S R^T g: scales, axes, rows of J W.
        let log_scales = p.u * by_u + p.v * by_v;
        let capped = p.scales.cmplt(Vec3::splat(MAX_SCALE_M));
        let log_scales = Vec3::select(capped, log_scales, Vec3::ZERO);
        out.geometry[column::LOG_SCALE..column::ROTATION].copy_from_slice(&log_scales.to_array());
        let (su, sv) = (p.scales * by_u, p.scales * by_v);
        let by_g = [p.rotation * su, p.rotation * sv];
        let axis = |k: usize| p.g[0] * su[k] + p.g[1] * sv[k];
        let turned = by_quaternion(&row[column::ROTATION..], [axis(0), axis(1), axis(2)]);
        out.geometry[column::ROTATION..column::LOGIT].copy_from_slice(&turned);

        // g = focal / z (row - at forward); mean = focal slope + centre.
        let mut by_d = Vec3::ZERO;
        let mut by_z = by.z;
        for k in 0..2 {
            by_z -= p.g[k].dot(by_g[k]) / p.z;
            let mut by_slope = view.focal[k] * by.mean[k];
            if p.at[k] == p.slope[k] {
                by_slope -= view.focal[k] / p.z * view.rows[2].dot(by_g[k]);
            }
            by_d += view.rows[k] * (by_slope / p.z);
            by_z -= by_slope * p.slope[k] / p.z;
        }
        by_d += view.rows[2] * by_z;

        // Colour, if not clamped at 0, and the viewing direction.
        let distance = p.d.length();
        let direction = p.d / distance;
        let basis = basis(direction, style.degree);
        let sums = colour(&row[column::SH..], &basis, style.degree);
        out.basis = basis;
        out.rgb = std::array::from_fn(|k| if sums[k] > 0.0 { by.rgb[k] } else { 0.0 });
        if style.degree > 0 {
            let by_direction = by_direction(&row[column::SH..], direction, style.degree, out.rgb);
            by_d += (by_direction - direction * direction.dot(by_direction)) / distance;
        }
        out.geometry[column::MEAN..column::LOG_SCALE].copy_from_slice(&by_d.to_array());
        out
    }
}

/// Returns the derivative by an unnormalised quaternion, from that by the columns of its rotation.
#[inline(always)]
fn by_quaternion(q: &[f32], columns: [Vec3; 3]) -> [f32; 4] {
    let length = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
    let [x, y, z, w]: [f32; 4] = std::array::from_fn(|k| q[k] / length);
    let [m0, m1, m2] = columns;
    // R = [1 - 2(yy + zz), 2(xy - wz), 2(xz + wy); ...], row by row.
    let by = [
        2.0 * (y * (m1.x + m0.y) + z * (m2.x + m0.z) - 2.0 * x * (m1.y + m2.z) + w * (m1.z - m2.y)),
        2.0 * (x * (m1.x + m0.y) + z * (m2.y + m1.z) - 2.0 * y * (m0.x + m2.z) + w * (m2.x - m0.z)),
        2.0 * (x * (m2.x + m0.z) + y * (m2.y + m1.z) - 2.0 * z * (m0.x + m1.y) + w * (m0.y - m1.x)),
        2.0 * (x * (m1.z - m2.y) + y * (m2.x - m0.z) + z * (m0.y - m1.x)),
    ];
    // Only the part perpendicular to q: its length does not rotate anything.
    let along = by[0] * x + by[1] * y + by[2] * z + by[3] * w;
    let unit = [x, y, z, w];
    std::array::from_fn(|k| (by[k] - along * unit[k]) / length)
}

/// Returns colours before they are clamped at 0.
#[inline(always)]
fn colour(sh: &[f32], basis: &[f32; 16], degree: u8) -> [f32; 3] {
    let mut rgb = [0.5; 3];
    for k in 0..coefficients(degree) {
        for channel in 0..3 {
            rgb[channel] += sh[3 * k + channel] * basis[k];
        }
    }
    rgb
}

/// Returns the basis functions up to a degree, along a unit direction; 0 above.
#[inline(always)]
pub(crate) fn basis(direction: Vec3, degree: u8) -> [f32; 16] {
    let mut out = [0.0; 16];
    let Vec3 { x, y, z } = direction;
    let (c1, c2, c3) = (C1 as f32, C2.map(|c| c as f32), C3.map(|c| c as f32));
    out[0] = C0 as f32;
    if degree >= 1 {
        out[1..4].copy_from_slice(&[-c1 * y, c1 * z, -c1 * x]);
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        out[4..9].copy_from_slice(&[
            c2[0] * x * y,
            c2[1] * y * z,
            c2[2] * (2.0 * zz - xx - yy),
            c2[3] * x * z,
            c2[4] * (xx - yy),
        ]);
    }
    if degree >= 3 {
        out[9..16].copy_from_slice(&[
            c3[0] * y * (3.0 * xx - yy),
            c3[1] * x * y * z,
            c3[2] * y * (4.0 * zz - xx - yy),
            c3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            c3[4] * x * (4.0 * zz - xx - yy),
            c3[5] * z * (xx - yy),
            c3[6] * x * (xx - 3.0 * yy),
        ]);
    }
    out
}

/// Returns the derivative of the colour, weighted by `by_rgb`, by the direction.
#[inline(always)]
fn by_direction(sh: &[f32], direction: Vec3, degree: u8, by_rgb: [f32; 3]) -> Vec3 {
    let weight =
        |k: usize| sh[3 * k] * by_rgb[0] + sh[3 * k + 1] * by_rgb[1] + sh[3 * k + 2] * by_rgb[2];
    let Vec3 { x, y, z } = direction;
    let (c1, c2, c3) = (C1 as f32, C2.map(|c| c as f32), C3.map(|c| c as f32));
    let mut sum = Vec3::new(-c1 * weight(3), -c1 * weight(1), c1 * weight(2));
    if degree >= 2 {
        let w: [f32; 5] = std::array::from_fn(|k| c2[k] * weight(4 + k));
        sum += Vec3::new(y, x, 0.0) * w[0]
            + Vec3::new(0.0, z, y) * w[1]
            + Vec3::new(-2.0 * x, -2.0 * y, 4.0 * z) * w[2]
            + Vec3::new(z, 0.0, x) * w[3]
            + Vec3::new(2.0 * x, -2.0 * y, 0.0) * w[4];
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let w: [f32; 7] = std::array::from_fn(|k| c3[k] * weight(9 + k));
        sum += Vec3::new(6.0 * x * y, 3.0 * (xx - yy), 0.0) * w[0]
            + Vec3::new(y * z, x * z, x * y) * w[1]
            + Vec3::new(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z) * w[2]
            + Vec3::new(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * (xx + yy)) * w[3]
            + Vec3::new(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z) * w[4]
            + Vec3::new(2.0 * x * z, -2.0 * y * z, xx - yy) * w[5]
            + Vec3::new(3.0 * (xx - yy), -6.0 * x * y, 0.0) * w[6];
    }
    sum
}
