//! Passes of a graphics card, compared with finite differences of the f64 reference and with the processor.
//!
//! The tests use any adapter, also software Vulkan (`mesa-vulkan-drivers`). Without an adapter, each test prints that
//! it is skipped.

use std::sync::OnceLock;

use super::*;
use crate::passes::Passes;
use crate::random::Random;
use crate::render::Renderer;
use crate::render::tests::{assert_differences, dense, rows, scene, view, weights};
use crate::{loss, reference};

/// Returns the adapter to test on.
fn adapter() -> Option<&'static Adapter> {
    static ADAPTERS: OnceLock<Vec<Adapter>> = OnceLock::new();
    let adapter = ADAPTERS.get_or_init(Adapter::all).first();
    if adapter.is_none() {
        println!("skipped: no graphics adapter; install mesa-vulkan-drivers and libvulkan1");
    }
    adapter
}

/// Returns passes with initial buffers for a number of pairs.
fn passes(pairs: u32) -> Option<GpuPasses> {
    let budget = Budget { pairs, ..Budget::default() };
    Some(GpuPasses::new(adapter()?, budget).expect("a device"))
}

/// Renders a view and propagates a derivative.
fn run(
    gpu: &mut GpuPasses,
    gaussians: &Gaussians,
    view: &View,
    style: Style,
    by: &Planes,
) -> (Planes, Vec<u32>, Gaussians) {
    let (mut seen, mut found) = (Vec::new(), Vec::new());
    gpu.forward(gaussians, Changed::All, view, style).expect("an image");
    gpu.backward(gaussians, view, style, by, &mut seen, &mut found).expect("gradients");
    assert!(seen.is_sorted() && seen.len() == found.len());
    let gradient = dense(gaussians, seen.iter().map(|&row| row as usize), &found);
    (gpu.image().clone(), seen, gradient)
}

#[test]
fn derivatives_match_finite_differences() {
    let Some(mut gpu) = passes(1 << 16) else { return };
    for (degree, antialiased) in [(0, false), (1, false), (3, false), (2, true)] {
        let view = view(35, 21);
        let style = Style { degree, antialiased };
        let gaussians = scene(25, degree, &view, 11 + u64::from(degree));
        let (weights, by) = weights(&view, 5);
        let (_, _, gradient) = run(&mut gpu, &gaussians, &view, style, &by);
        // Exponentials of drivers deviate by 1e-5, and steep Gaussians amplify that.
        assert_differences(&gaussians, &view, style, &weights, &gradient, 4e-3);
    }
}

#[test]
fn image_matches_the_reference() {
    let Some(mut gpu) = passes(1 << 16) else { return };
    for (degree, antialiased) in [(0, false), (3, false), (2, true)] {
        let view = view(70, 50);
        let style = Style { degree, antialiased };
        let gaussians = scene(500, degree, &view, 7);
        let expected = reference::render(&rows(&gaussians), gaussians.stride(), &view, style);
        gpu.forward(&gaussians, Changed::All, &view, style).expect("an image");
        let mut off = 0;
        for (i, expected) in expected.iter().enumerate() {
            let (x, y) = (i % view.width, i / view.width);
            let error = (0..channel::COUNT)
                .map(|c| {
                    let z = if c == channel::SECOND { 10.0 } else { 1.0 };
                    (f64::from(gpu.image().at(c, x, y)) - expected[c]).abs() / z
                })
                .fold(0.0, f64::max);
            // A Gaussian at the threshold of 1/255 is in one image and not in the other.
            off += usize::from(error > 5e-4);
            assert!(error < 0.03, "{error} at {x}, {y}");
        }
        assert!(off <= 4, "{off} pixels are off");
    }
}

#[test]
fn gradients_match_the_processor() {
    let Some(mut gpu) = passes(1 << 16) else { return };
    for (degree, antialiased) in [(0, false), (2, false), (3, true)] {
        let view = view(150, 130);
        let style = Style { degree, antialiased };
        let gaussians = scene(5000, degree, &view, 3);
        let (_, mut by) = weights(&view, 8);
        for y in 0..view.height {
            by.row_mut(channel::ERROR, y).fill(1.0);
        }
        let mut cpu = Renderer::default();
        cpu.forward(&gaussians, &view, style);
        let mut expected = Vec::new();
        cpu.backward(&gaussians, &view, style, &by, &mut expected);
        let errors: f32 = expected.iter().map(|by| by.error).sum();
        let seen_by_cpu: Vec<u32> = cpu.seen().map(|row| row as u32).collect();
        let expected = dense(&gaussians, cpu.seen(), &expected);
        let (_, seen, found) = run(&mut gpu, &gaussians, &view, style, &by);

        // A Gaussian at the threshold of 1/255 may be visible on only one of the two.
        let apart = seen.len().abs_diff(seen_by_cpu.len());
        assert!(apart <= 3, "{} rows seen for {}", seen.len(), seen_by_cpu.len());
        let (mut seen, mut gradients) = (Vec::new(), Vec::new());
        gpu.backward(&gaussians, &view, style, &by, &mut seen, &mut gradients).expect("gradients");
        let found_errors: f32 = gradients.iter().map(|by| by.error).sum();
        assert!((found_errors / errors - 1.0).abs() < 1e-3, "{found_errors} for {errors}");
        for column in 0..gaussians.stride() {
            let values = || (column..found.values.len()).step_by(gaussians.stride());
            let square = |of: &dyn Fn(usize) -> f32| {
                values().map(|i| f64::from(of(i)).powi(2)).sum::<f64>().sqrt()
            };
            let off = square(&|i| found.values[i] - expected.values[i])
                / square(&|i| expected.values[i]).max(1e-9);
            assert!(off < 5e-3, "degree {degree}, column {column}: off by {off}");
        }
    }
}

#[test]
fn results_are_bit_identical_for_all_runs_and_buffer_sizes() {
    let Some(mut gpu) = passes(1 << 20) else { return };
    let (wide, view) = (view(300, 200), view(150, 130));
    let style = Style { degree: 2, antialiased: false };
    let gaussians = scene(5000, 2, &view, 3);
    let (_, by) = weights(&view, 8);
    let bits = |(image, seen, gradient): (Planes, Vec<u32>, Gaussians)| {
        let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        (bits(&image.values), seen, bits(&gradient.values))
    };
    let expected = bits(run(&mut gpu, &gaussians, &view, style, &by));
    // A larger photo in between leaves its values in all buffers.
    let other = scene(9000, 2, &view, 5);
    run(&mut gpu, &other, &wide, style, &weights(&wide, 2).1);
    assert!(bits(run(&mut gpu, &gaussians, &view, style, &by)) == expected, "the second time");
    for pairs in [1, 1000] {
        let mut gpu = passes(pairs).expect("an adapter was there");
        assert!(bits(run(&mut gpu, &gaussians, &view, style, &by)) == expected, "{pairs} pairs");
    }
}

#[test]
fn uploading_only_changed_rows_renders_the_same_image() {
    let Some(mut gpu) = passes(1 << 16) else { return };
    let (wide, narrow) = (view(300, 200), view(150, 130));
    let style = Style { degree: 2, antialiased: false };
    let mut gaussians = scene(3000, 2, &narrow, 3);
    let mut random = Random::new(7);
    let mut whole = passes(1 << 16).expect("an adapter was there");
    let mut check = |gaussians: &Gaussians, changed: Changed<'_>, view: &View| {
        gpu.forward(gaussians, changed, view, style).expect("an image");
        whole.forward(gaussians, Changed::All, view, style).expect("an image");
        let bits =
            |gpu: &GpuPasses| gpu.image().values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert!(bits(&gpu) == bits(&whole), "{} rows, {changed:?}", gaussians.len());
    };
    // The device has no Gaussians yet, so it must upload all of them.
    check(&gaussians, Changed::Rows { rows: &[], columns: 0 }, &narrow);
    // Few and many, odd and even counts; then a larger photo, which reallocates all buffers.
    for (count, columns, view) in [
        (1, 3, &narrow),
        (2, 14, &narrow),
        (777, 23, &narrow),
        (1500, 38, &narrow),
        (2999, 38, &narrow),
        (3000, 38, &narrow),
        (500, 38, &wide),
        (40, 38, &narrow),
        (900, 0, &narrow),
    ] {
        let mut rows: Vec<u32> = (0..gaussians.len() as u32).collect();
        random.shuffle(&mut rows);
        rows.truncate(count);
        for &row in &rows {
            for value in &mut gaussians.row_mut(row as usize)[..columns] {
                *value += 0.02 * random.normal();
            }
        }
        check(&gaussians, Changed::Rows { rows: &rows, columns }, view);
    }
    // More and fewer Gaussians: the device must upload all of them.
    let more = scene(3001, 2, &narrow, 4);
    check(&more, Changed::Rows { rows: &[3000], columns: 38 }, &narrow);
    let fewer = scene(2000, 2, &narrow, 5);
    check(&fewer, Changed::Rows { rows: &[], columns: 0 }, &narrow);
}

#[test]
fn renders_all_photo_sizes_and_empty_scenes() {
    let Some(mut gpu) = passes(1 << 10) else { return };
    let style = Style { degree: 0, antialiased: false };
    for (width, height) in [(1, 1), (16, 16), (15, 33), (97, 3)] {
        let view = view(width, height);
        let (_, by) = weights(&view, 2);
        for count in [0, 1, 300] {
            let gaussians = scene(count, 0, &view, 5);
            let (image, _, gradient) = run(&mut gpu, &gaussians, &view, style, &by);
            let mut cpu = Renderer::default();
            let expected = cpu.forward(&gaussians, &view, style);
            for y in 0..view.height {
                let rows = image.row(5, y).iter().zip(expected.row(5, y));
                assert!(rows.into_iter().all(|(a, b)| (a - b).abs() < 0.03), "{width} {count}");
            }
            assert!(gradient.values.iter().all(|v| v.is_finite()));
        }
    }
}

#[test]
fn ignores_gaussians_that_are_not_finite() {
    let Some(mut gpu) = passes(1 << 16) else { return };
    let view = view(32, 32);
    let style = Style { degree: 0, antialiased: false };
    let mut gaussians = scene(40, 0, &view, 3);
    let (_, by) = weights(&view, 8);
    let (clean, _, _) = run(&mut gpu, &gaussians, &view, style, &by);
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for column in [column::MEAN, column::LOG_SCALE, column::ROTATION] {
            let at = view.unproject([16.0, 16.0], 1.0);
            gaussians.push(at, Vec3::splat(0.1), glam::Quat::IDENTITY, 0.9, [0.5; 3]);
            let last = gaussians.len() - 1;
            gaussians.row_mut(last)[column] = poison;
            let (image, _, _) = run(&mut gpu, &gaussians, &view, style, &by);
            assert!(image.values.iter().all(|v| v.is_finite()), "{poison} in column {column}");
            gaussians.values.truncate(last * gaussians.stride());
        }
    }
    assert!(clean == run(&mut gpu, &gaussians, &view, style, &by).0);
}

#[test]
fn reports_a_lost_device_and_continues_on_the_processor() {
    let Some(adapter) = adapter() else { return };
    let view = view(40, 30);
    let style = Style { degree: 1, antialiased: false };
    let gaussians = scene(200, 1, &view, 3);
    let (_, by) = weights(&view, 8);
    let mut cpu = Passes::cpu();
    let (mut seen, mut expected) = (Vec::new(), Vec::new());
    cpu.forward(&gaussians, Changed::All, &view, style);
    cpu.backward(&gaussians, &view, style, &by, &mut seen, &mut expected);
    let numbers = |of: &[RowGradient]| of.iter().map(|by| by.geometry).collect::<Vec<_>>();
    // Lose the device before the image, or between the image and its derivative.
    for early in [true, false] {
        let mut passes = Passes::gpu(adapter, Budget::default()).expect("a device");
        assert!(passes.name().starts_with("gpu "));
        let (mut again, mut found) = (Vec::new(), Vec::new());
        if early {
            passes.lose_device();
        }
        passes.forward(&gaussians, Changed::All, &view, style);
        passes.lose_device();
        passes.backward(&gaussians, &view, style, &by, &mut again, &mut found);
        assert!(passes.name().starts_with("cpu "));
        let lost = passes.take_lost().expect("it says so");
        assert!(lost.starts_with("gpu ") && passes.take_lost().is_none(), "{lost}");
        assert!(again == seen && numbers(&found) == numbers(&expected));
    }
}

#[test]
fn trial_accepts_a_correct_adapter() {
    if adapter().is_none() {
        return;
    }
    let (passes, reason) = Passes::choose(vizflyt_splat::Backend::Gpu).expect("an adapter");
    assert!(passes.name().starts_with("gpu ") && reason.contains("trains as"), "{reason}");
}

#[test]
fn loss_of_a_device_image_equals_the_processors() {
    let Some(mut gpu) = passes(1 << 16) else { return };
    let view = view(64, 48);
    let style = Style { degree: 0, antialiased: false };
    let gaussians = scene(400, 0, &view, 3);
    let target = loss::Target {
        width: 64,
        height: 48,
        rgb: (0..64 * 48 * 3).map(|i| (i * 7 % 251) as u8).collect(),
        ..loss::Target::default()
    };
    let weights = loss::Weights { dssim: 0.2, depth: 0.5, spread: 0.02, bend: 0.1 };
    let mut cpu = Renderer::default();
    gpu.forward(&gaussians, Changed::All, &view, style).expect("an image");
    let [a, b] = [gpu.image(), cpu.forward(&gaussians, &view, style)].map(|image| {
        let exposure = loss::Exposure::default();
        let mut loss = loss::Loss::default();
        loss.of(image, &target, &exposure, [0.3; 3], &weights).0.total(&weights)
    });
    assert!((a / b - 1.0).abs() < 1e-3, "{a} for {b}");
}
