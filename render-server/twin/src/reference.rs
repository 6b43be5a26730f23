//! Reference implementation of the passes: f64, pixel by pixel, without tiles. Tests compare derivatives with its
//! finite differences.

use glam::{DMat3, DQuat, DVec3, Vec3};
use vizflyt_splat::harmonics;
use vizflyt_splat::limits::{ALPHA_MAX, ALPHA_MIN, BLUR_PX2, TRANSMITTANCE_MIN};

use crate::gaussians::{coefficients, column};
use crate::project::Style;
use crate::render::channel;
use crate::view::View;

/// Renders rows of parameters. Returns the channels of every pixel, row by row; see [`channel`].
pub fn render(
    rows: &[f64],
    stride: usize,
    view: &View,
    style: Style,
) -> Vec<[f64; channel::COUNT]> {
    let mut flats: Vec<Flat> =
        rows.chunks_exact(stride).filter_map(|row| Flat::of(row, view, style)).collect();
    flats.sort_by(|a, b| a.z.total_cmp(&b.z));
    let pixels = (0..view.height).flat_map(|y| (0..view.width).map(move |x| (x, y)));
    pixels.map(|(x, y)| blend(&flats, x as f64 + 0.5, y as f64 + 0.5)).collect()
}

fn blend(flats: &[Flat], x: f64, y: f64) -> [f64; channel::COUNT] {
    let mut out = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    for flat in flats {
        let (dx, dy) = (x - flat.mean[0], y - flat.mean[1]);
        let [a, b, c] = flat.covariance;
        let sigma = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (2.0 * (a * c - b * b));
        let alpha = (flat.opacity * (-sigma).exp()).min(ALPHA_MAX);
        if alpha < ALPHA_MIN {
            continue;
        }
        let before = out[channel::TRANSMITTANCE];
        let after = before * (1.0 - alpha);
        if after <= TRANSMITTANCE_MIN {
            break;
        }
        let weight = alpha * before;
        for k in 0..3 {
            out[k] += weight * flat.rgb[k];
        }
        out[channel::FIRST] += weight * flat.z;
        out[channel::SECOND] += weight * flat.z * flat.z;
        out[channel::TRANSMITTANCE] = after;
    }
    out
}

struct Flat {
    mean: [f64; 2],
    covariance: [f64; 3],
    opacity: f64,
    z: f64,
    rgb: [f64; 3],
}

impl Flat {
    fn of(row: &[f64], view: &View, style: Style) -> Option<Self> {
        let d = DVec3::from_slice(&row[column::MEAN..]) - view.position.as_dvec3();
        let rows = view.rows.map(Vec3::as_dvec3);
        let z = rows[2].dot(d);
        if z <= f64::from(view.near) {
            return None;
        }
        let focal = view.focal.map(f64::from);
        let slope = [rows[0].dot(d) / z, rows[1].dot(d) / z];
        let jacobian: [DVec3; 2] = std::array::from_fn(|k| {
            let [low, high] = view.slopes[k].map(f64::from);
            (rows[k] - rows[2] * slope[k].clamp(low, high)) * (focal[k] / z)
        });
        let rotation = DQuat::from_slice(&row[column::ROTATION..]).normalize();
        let scales = DVec3::from_slice(&row[column::LOG_SCALE..]).to_array().map(f64::exp);
        let axes = DMat3::from_quat(rotation) * DMat3::from_diagonal(DVec3::from(scales));
        let covariance = axes * axes.transpose();
        let of = |i: usize, j: usize| jacobian[i].dot(covariance * jacobian[j]);
        let (a, b, c) = (of(0, 0), of(0, 1), of(1, 1));
        let blurred = [a + BLUR_PX2, b, c + BLUR_PX2];
        let mut opacity = 1.0 / (1.0 + (-row[column::LOGIT]).exp());
        if style.antialiased {
            let ratio = (a * c - b * b) / (blurred[0] * blurred[2] - b * b);
            opacity *= ratio.max(1e-8).sqrt();
        }
        let direction = d.normalize();
        let basis = harmonics::basis(direction.to_array());
        let mut rgb = [0.5; 3];
        for k in 0..coefficients(style.degree) {
            for channel in 0..3 {
                rgb[channel] += row[column::SH + 3 * k + channel] * basis[k];
            }
        }
        Some(Self {
            mean: std::array::from_fn(|k| focal[k] * slope[k] + f64::from(view.center[k])),
            covariance: blurred,
            opacity,
            z,
            rgb: rgb.map(|v| v.max(0.0)),
        })
    }
}
