//! Test scene for graphics adapters: some drivers sort wrongly or render nothing.

use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::gpu::training::Changed;

use crate::gaussians::Gaussians;
use crate::gpu::GpuPasses;
use crate::planes::Planes;
use crate::project::{RowGradient, Style};
use crate::random::Random;
use crate::render::{Renderer, channel};
use crate::view::View;

/// Maximum RMS deviation of the gradients, relative to their RMS. Correct adapters deviate by 1e-4: a splat at the
/// threshold of 1/255 is in one image and not in the other.
const MAX_OFF: f64 = 1e-2;

/// Returns the relative deviation of an adapter's derivatives, or the reason to reject it.
pub(super) fn check(gpu: &mut GpuPasses) -> Result<f64, String> {
    let (gaussians, view) = scene();
    let style = Style { degree: 1, antialiased: false };
    let by = derivative(&view);
    let mut cpu = Renderer::default();
    cpu.forward(&gaussians, &view, style);
    let mut expected = Vec::new();
    cpu.backward(&gaussians, &view, style, &by, &mut expected);
    let expected = dense(&gaussians, cpu.seen(), &expected);

    let mut runs = Vec::new();
    for _ in 0..2 {
        let (mut seen, mut found) = (Vec::new(), Vec::new());
        gpu.forward(&gaussians, Changed::All, &view, style).map_err(|error| error.to_string())?;
        gpu.backward(&gaussians, &view, style, &by, &mut seen, &mut found)
            .map_err(|error| error.to_string())?;
        runs.push(dense(&gaussians, seen.iter().map(|&row| row as usize), &found));
    }
    if runs[0] != runs[1] {
        return Err("derivatives of the test scene differ between two runs".to_owned());
    }
    let squares =
        |of: &dyn Fn(usize) -> f64| (0..expected.len()).map(|i| of(i).powi(2)).sum::<f64>();
    let apart = squares(&|i| f64::from(runs[0][i]) - f64::from(expected[i]));
    let off = (apart / squares(&|i| f64::from(expected[i]))).sqrt();
    // Positive condition, so that NaN is rejected.
    if off <= MAX_OFF {
        Ok(off)
    } else {
        Err(format!("derivatives of the test scene deviate by {off:.0e}"))
    }
}

/// Returns gradients row by row: geometry, colour.
fn dense(
    gaussians: &Gaussians,
    seen: impl Iterator<Item = usize>,
    found: &[RowGradient],
) -> Vec<f32> {
    const NUMBERS: usize = 14;
    let mut out = vec![0.0; gaussians.len() * NUMBERS];
    for (row, by) in seen.zip(found) {
        out[row * NUMBERS..][..11].copy_from_slice(&by.geometry);
        out[row * NUMBERS + 11..][..3].copy_from_slice(&by.rgb);
    }
    out
}

/// Returns 5000 Gaussians in many layers (more than one group of the sort holds), and a view of most of them.
fn scene() -> (Gaussians, View) {
    let pose = Pose::new(DVec3::ZERO, DQuat::IDENTITY);
    let view = View::new(&Intrinsics::from_horizontal_fov(100, 75, 1.3), &pose, 0.05);
    let mut random = Random::new(4);
    let mut gaussians = Gaussians::new(1);
    for i in 0..5000 {
        let mean =
            Vec3::new(random.within(-2.0, 2.0), random.within(-1.5, 1.5), random.within(1.0, 4.0));
        let scales = Vec3::from_array(std::array::from_fn(|_| random.within(0.01, 0.05)));
        let q = Quat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
        let rgb = std::array::from_fn(|_| random.unit());
        gaussians.push(mean, scales, q.normalize(), random.within(0.05, 0.95), rgb);
        for value in gaussians.row_mut(i).iter_mut().skip(14) {
            *value = random.within(-0.3, 0.3);
        }
    }
    (gaussians, view)
}

/// Returns a random derivative by the channels of a view's image.
fn derivative(view: &View) -> Planes {
    let mut random = Random::new(9);
    let mut by = Planes::default();
    by.resize(channel::BY_COUNT, view.width, view.height);
    for channel in 0..channel::COUNT {
        for y in 0..view.height {
            by.row_mut(channel, y).fill_with(|| random.normal());
        }
    }
    by
}
