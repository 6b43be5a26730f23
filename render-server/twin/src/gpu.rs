//! Passes on a graphics card: adapts `vizflyt_splat::gpu::training` to the trainer's types.

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

/// Renders Gaussians and propagates derivatives back to them on a device.
#[derive(Debug)]
pub(crate) struct GpuPasses {
    renderer: TrainingRenderer,
    /// Last rendered image.
    image: Planes,
    /// Index of each row's gradient in the device's results; [`UNSEEN`] if the row has none.
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

    /// Returns `gpu`, the adapter's name and the graphics API.
    pub(crate) fn name(&self) -> &str {
        self.renderer.name()
    }

    /// Returns the last rendered image.
    pub(crate) fn image(&self) -> &Planes {
        &self.image
    }

    /// Returns the device's time by part, over all photos.
    pub(crate) fn times(&self) -> TrainingTimes {
        self.renderer.times()
    }

    /// Destroys the device, as a driver reset does.
    pub(crate) fn lose_device(&self) {
        self.renderer.lose_device();
    }

    /// Renders a view. `changed` lists the Gaussians that may differ from the last call.
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

    /// Propagates a derivative by the last image's channels: fills `seen` with the visible rows, in ascending order,
    /// and `out` with one gradient each.
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
            // Each row occurs at most once, so the order of the threads does not matter.
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
