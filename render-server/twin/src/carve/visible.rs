//! Visibility of splats: a splat behind a surface in every photo was constrained by none, and is haze.

use vizflyt_splat::Splats;

use crate::dataset::Dataset;
use crate::gaussians::Gaussians;
use crate::planes::Planes;
use crate::project::Style;
use crate::render::{Renderer, channel};

/// Returns the sum of each splat's visible pixels over all photos.
pub(super) fn pixels(dataset: &Dataset, splats: &Splats) -> Vec<f32> {
    let gaussians = Gaussians::from_splats(splats);
    let style = Style { degree: splats.sh_degree, antialiased: splats.antialiased };
    let mut renderer = Renderer::default();
    let (mut ones, mut gradients, mut rows) = (Planes::default(), Vec::new(), Vec::new());
    let mut pixels = vec![0.0f32; splats.len()];
    for photo in &dataset.photos {
        let (width, height) = (photo.view.width, photo.view.height);
        ones.values.clear();
        ones.resize(channel::BY_COUNT, width, height);
        // Set the error of every pixel to 1, so that its sum through a splat counts pixels.
        (0..height).for_each(|y| ones.row_mut(channel::ERROR, y).fill(1.0));
        renderer.forward(&gaussians, &photo.view, style);
        rows.clear();
        rows.extend(renderer.seen());
        renderer.backward(&gaussians, &photo.view, style, &ones, &mut gradients);
        for (&row, gradient) in rows.iter().zip(&gradients) {
            pixels[row] += gradient.error;
        }
    }
    pixels
}
