//! The passes on a graphics card: `vizflyt_splat::gpu::training` in the trainer's words.

use std::sync::atomic::{AtomicU32, Ordering};

use glam::Vec3;
use rayon::prelude::*;
use vizflyt_splat::RenderError;
use vizflyt_splat::gpu::training::{self, Changed, Photo, TrainingRenderer, TrainingTimes};
use vizflyt_splat::gpu::{Adapter, Budget};

use crate::gaussians::{Gaussians, column};
use crate::planes::Planes;
use crate::project::{RowGradient, Style, basis};
use crate::render::channel;
use crate::view::View;

const _: () = assert!(
    training::CHANNELS == channel::COUNT && training::BY_CHANNELS == channel::BY_COUNT,
    "both have the same channels"
);

/// Renders Gaussians and takes derivatives back to them on a device.
#[derive(Debug)]
pub(crate) struct GpuPasses {
    renderer: TrainingRenderer,
    /// Of the view rendered last.
    image: Planes,
    /// Where each row's gradient is in what the device found; [`UNSEEN`] where there is none.
    places: Vec<AtomicU32>,
}

const UNSEEN: u32 = u32::MAX;

impl GpuPasses {
    /// Opens a device.
    pub(crate) fn new(adapter: &Adapter, budget: Budget) -> Result<Self, RenderError> {
        Ok(Self {
            renderer: TrainingRenderer::new(adapter, budget)?,
            image: Planes::default(),
            places: Vec::new(),
        })
    }

    /// Returns `gpu`, the adapter's name and the interface.
    pub(crate) fn name(&self) -> &str {
        self.renderer.name()
    }

    /// Returns the image rendered last.
    pub(crate) fn image(&self) -> &Planes {
        &self.image
    }

    /// Returns where the time of all photos so far went.
    pub(crate) fn times(&self) -> TrainingTimes {
        self.renderer.times()
    }

    /// Destroys the device, as a driver's reset does.
    pub(crate) fn lose_device(&self) {
        self.renderer.lose_device();
    }

    /// Renders the image of a view; `changed` is what may differ from the Gaussians of the last one.
    pub(crate) fn forward(
        &mut self,
        gaussians: &Gaussians,
        changed: Changed<'_>,
        view: &View,
        style: Style,
    ) -> Result<(), RenderError> {
        self.image.resize(channel::COUNT, view.width, view.height);
        let photo = Photo {
            width: view.width as u32,
            height: view.height as u32,
            focal: view.focal,
            center: view.center,
            axes: view.rows,
            position: view.position,
            near: view.near,
            slopes: view.slopes,
            degree: style.degree,
            antialiased: style.antialiased,
        };
        let image = &mut self.image.values;
        self.renderer.forward(&gaussians.values, gaussians.stride(), changed, &photo, image)
    }

    /// Takes the derivative of a loss by the last image's channels back: fills `seen` with the rows that it
    /// shows, ascending, and `out` with as many gradients.
    pub(crate) fn backward(
        &mut self,
        gaussians: &Gaussians,
        view: &View,
        style: Style,
        by: &Planes,
        seen: &mut Vec<u32>,
        out: &mut Vec<RowGradient>,
    ) -> Result<(), RenderError> {
        let places = &mut self.places;
        self.renderer.backward(&by.values, |found| {
            places.resize_with(gaussians.len(), AtomicU32::default);
            places.par_iter_mut().with_min_len(1 << 14).for_each(|p| *p.get_mut() = UNSEEN);
            // A row is found once: which thread notes it makes no difference.
            found.par_iter().enumerate().with_min_len(4096).for_each(|(place, found)| {
                places[found.row()].store(place as u32, Ordering::Relaxed);
            });
            let place = |row: u32| places[row as usize].load(Ordering::Relaxed);
            let rows = (0..gaussians.len() as u32).into_par_iter().with_min_len(4096);
            seen.clear();
            seen.par_extend(rows.filter(|&row| place(row) != UNSEEN));
            seen.par_iter()
                .with_min_len(1024)
                .map(|&row| {
                    let by = &found[place(row) as usize];
                    let mean = Vec3::from_slice(&gaussians.row(row as usize)[column::MEAN..]);
                    let d = mean - view.position;
                    RowGradient {
                        geometry: by.geometry,
                        basis: basis(d / d.length(), style.degree),
                        rgb: by.rgb,
                        error: by.error,
                    }
                })
                .collect_into_vec(out);
        })
    }
}

#[cfg(test)]
mod tests;
