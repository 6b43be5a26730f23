//! Compares derivatives with finite differences of the f64 reference, and images with the reference and with
//! `vizflyt-splat`'s renderers.

use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Camera, render_reference};

use super::*;
use crate::gaussians::column;
use crate::random::Random;
use crate::reference;

fn pose() -> Pose<vizflyt_protocol::geometry::World, vizflyt_protocol::geometry::Cam> {
    Pose::new(DVec3::new(0.4, -0.3, 0.2), DQuat::from_euler(glam::EulerRot::XYZ, 0.2, -0.4, 1.0))
}

pub(crate) fn view(width: u32, height: u32) -> View {
    View::new(&Intrinsics::from_horizontal_fov(width, height, 1.4), &pose(), 0.05)
}

/// Returns Gaussians in front of the camera, some outside the image, some thin, some faint.
pub(crate) fn scene(count: usize, degree: u8, view: &View, seed: u64) -> Gaussians {
    let mut random = Random::new(seed);
    let mut gaussians = Gaussians::new(degree);
    for i in 0..count {
        let pixel = [
            random.within(-0.2, 1.2) * view.width as f32,
            random.within(-0.2, 1.2) * view.height as f32,
        ];
        let z = random.within(0.6, 4.0);
        let size = random.within(0.5, 6.0) * z / view.focal[0];
        let flat = if i % 3 == 0 { 0.02 } else { random.within(0.3, 1.0) };
        let scales = Vec3::new(size, size * random.within(0.3, 1.0), size * flat);
        let q = Quat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
        let opacity = random.within(0.05, 0.97);
        gaussians.push(view.unproject(pixel, z), scales, q.normalize(), opacity, [0.0; 3]);
        let row = gaussians.row_mut(i);
        for value in &mut row[column::ROTATION..column::LOGIT] {
            *value *= 1.7;
        }
        for value in &mut row[column::SH..] {
            *value = 0.5 * random.normal();
        }
    }
    gaussians
}

pub(crate) fn rows(gaussians: &Gaussians) -> Vec<f64> {
    gaussians.values.iter().map(|&v| f64::from(v)).collect()
}

/// Returns random weights of the channels, pixel by pixel, and the same weights as planes.
pub(crate) fn weights(view: &View, seed: u64) -> (Vec<[f64; channel::COUNT]>, Planes) {
    let mut random = Random::new(seed);
    let mut by = Planes::default();
    by.resize(channel::BY_COUNT, view.width, view.height);
    let mut weights = Vec::new();
    for y in 0..view.height {
        for x in 0..view.width {
            let pixel: [f32; channel::COUNT] = std::array::from_fn(|_| random.normal());
            for (channel, &weight) in pixel.iter().enumerate() {
                *by.at_mut(channel, x, y) = weight;
            }
            weights.push(pixel.map(f64::from));
        }
    }
    (weights, by)
}

fn check_gradients(degree: u8, antialiased: bool, instructions: InstructionSet) {
    let view = view(35, 21);
    let style = Style { degree, antialiased };
    let gaussians = scene(25, degree, &view, 11 + u64::from(degree));
    let (weights, by) = weights(&view, 5);
    let mut renderer = Renderer::with(instructions);
    renderer.forward(&gaussians, &view, style);
    let mut found = Vec::new();
    renderer.backward(&gaussians, &view, style, &by, &mut found);
    let gradient = dense(&gaussians, renderer.seen(), &found);
    assert_differences(&gaussians, &view, style, &weights, &gradient, 2e-3);
}

/// Returns gradients row by row; zero for unseen rows.
pub(crate) fn dense(
    gaussians: &Gaussians,
    seen: impl Iterator<Item = usize>,
    found: &[RowGradient],
) -> Gaussians {
    let mut gradient = gaussians.zeros();
    for (row, found) in seen.zip(found) {
        let out = gradient.row_mut(row);
        out[..column::SH].copy_from_slice(&found.geometry);
        for (k, out) in out[column::SH..].iter_mut().enumerate() {
            *out = found.basis[k / 3] * found.rgb[k % 3];
        }
    }
    gradient
}

/// Asserts that a gradient equals finite differences of the weighted reference. The tolerance is `share` of the value
/// plus `share` of its column's RMS.
pub(crate) fn assert_differences(
    gaussians: &Gaussians,
    view: &View,
    style: Style,
    weights: &[[f64; channel::COUNT]],
    gradient: &Gaussians,
    share: f64,
) {
    let (stride, degree) = (gaussians.stride(), gaussians.degree);
    let loss = |rows: &[f64]| -> f64 {
        let image = reference::render(rows, stride, view, style);
        image
            .iter()
            .zip(weights)
            .map(|(p, w)| (0..channel::COUNT).map(|c| p[c] * w[c]).sum::<f64>())
            .sum()
    };
    let mut rows = rows(gaussians);
    let expected: Vec<f64> = (0..rows.len())
        .map(|i| {
            const STEP: f64 = 1e-6;
            let here = rows[i];
            rows[i] = here + STEP;
            let above = loss(&rows);
            rows[i] = here - STEP;
            let below = loss(&rows);
            rows[i] = here;
            (above - below) / (2.0 * STEP)
        })
        .collect();
    // Column by column: small values are compared relative to the column's RMS.
    for column in 0..stride {
        let values = || (column..rows.len()).step_by(stride);
        let usual =
            (values().map(|i| expected[i].powi(2)).sum::<f64>() / gaussians.len() as f64).sqrt();
        assert!(usual > 0.0, "column {column} has no derivative at all");
        for i in values() {
            let (want, got) = (expected[i], f64::from(gradient.values[i]));
            assert!(
                (want - got).abs() <= share * want.abs() + share * usual,
                "degree {degree}, row {}, column {column}: {got} for {want} (usual {usual})",
                i / stride
            );
        }
    }
}

#[test]
fn derivatives_match_finite_differences() {
    for degree in [0, 1, 3] {
        check_gradients(degree, false, InstructionSet::available()[0]);
    }
    check_gradients(2, true, InstructionSet::available()[0]);
}

#[test]
fn derivatives_match_on_every_instruction_set() {
    for instructions in InstructionSet::available() {
        check_gradients(0, false, instructions);
    }
}

#[test]
fn image_matches_the_reference() {
    for (degree, antialiased) in [(0, false), (3, false), (2, true)] {
        let view = view(70, 50);
        let style = Style { degree, antialiased };
        let gaussians = scene(500, degree, &view, 7);
        let expected = reference::render(&rows(&gaussians), gaussians.stride(), &view, style);
        for instructions in InstructionSet::available() {
            let mut renderer = Renderer::with(instructions);
            let image = renderer.forward(&gaussians, &view, style);
            let mut worst = [0.0; channel::COUNT];
            let mut off = 0;
            for (i, expected) in expected.iter().enumerate() {
                let (x, y) = (i % view.width, i / view.width);
                let errors: [f64; channel::COUNT] = std::array::from_fn(|c| {
                    let z = if c == channel::SECOND { 10.0 } else { 1.0 };
                    (f64::from(image.at(c, x, y)) - expected[c]).abs() / z
                });
                // A Gaussian at the threshold of 1/255 is in one image and not in the other.
                off += usize::from(errors.iter().any(|&e| e > 2e-4));
                for c in 0..channel::COUNT {
                    worst[c] = errors[c].max(worst[c]);
                }
            }
            assert!(off <= 4, "{off} pixels are off, by up to {worst:?}");
            assert!(worst.iter().all(|&e| e < 0.03), "{worst:?}");
        }
    }
}

#[test]
fn image_matches_the_flight_renderer() {
    let view = view(70, 50);
    let gaussians = scene(500, 3, &view, 9);
    let mut camera = Camera::new(Intrinsics::from_horizontal_fov(70, 50, 1.4), pose(), view.near);
    camera.background = [0.0; 3];
    let expected = render_reference(&gaussians.to_splats(), &[], &camera).unwrap();
    let mut renderer = Renderer::default();
    let image = renderer.forward(&gaussians, &view, Style { degree: 3, antialiased: false });
    let mut off = 0;
    for i in 0..view.width * view.height {
        let (x, y) = (i % view.width, i / view.width);
        let alpha = 1.0 - image.at(channel::TRANSMITTANCE, x, y);
        let depth = image.at(channel::FIRST, x, y) / alpha.max(1e-6);
        let mut error = (alpha - expected.alpha[i]).abs();
        if alpha > 0.0 {
            error = error.max(alpha * (depth - expected.depth_expected_m[i]).abs());
        }
        for c in 0..3 {
            error = error.max((image.at(c, x, y) - expected.rgb[3 * i + c]).abs());
        }
        off += usize::from(error > 3e-4);
    }
    assert!(off <= 4, "{off} pixels are off");
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let view = view(150, 130);
    let style = Style { degree: 2, antialiased: false };
    let gaussians = scene(5000, 2, &view, 3);
    let (_, by) = weights(&view, 8);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut renderer = Renderer::default();
            let image = renderer.forward(&gaussians, &view, style).clone();
            let mut found = Vec::new();
            renderer.backward(&gaussians, &view, style, &by, &mut found);
            let numbers: Vec<u32> = found
                .iter()
                .flat_map(|g| g.geometry.iter().chain(&g.rgb))
                .map(|v| v.to_bits())
                .collect();
            (image, numbers)
        })
    };
    let one = run(1);
    for threads in [2, 3, 7] {
        assert!(one == run(threads), "{threads} threads give a different result");
    }
}

#[test]
fn ignores_gaussians_that_are_not_finite() {
    let view = view(32, 32);
    let style = Style { degree: 0, antialiased: false };
    let mut gaussians = scene(40, 0, &view, 3);
    let mut renderer = Renderer::default();
    let clean = renderer.forward(&gaussians, &view, style).clone();
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for column in [column::MEAN, column::LOG_SCALE, column::ROTATION] {
            gaussians.push(
                view.unproject([16.0, 16.0], 1.0),
                Vec3::splat(0.1),
                Quat::IDENTITY,
                0.9,
                [0.5; 3],
            );
            let last = gaussians.len() - 1;
            gaussians.row_mut(last)[column] = poison;
            let image = renderer.forward(&gaussians, &view, style);
            assert!(image.values.iter().all(|v| v.is_finite()), "{poison} in column {column}");
            let (_, by) = weights(&view, 8);
            let mut found = Vec::new();
            renderer.backward(&gaussians, &view, style, &by, &mut found);
            gaussians.values.truncate(last * gaussians.stride());
        }
    }
    assert!(&clean == renderer.forward(&gaussians, &view, style));
}
