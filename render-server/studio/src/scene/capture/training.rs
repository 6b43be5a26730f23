//! Fifth stage: trains splats on the metric model, and writes held-out photos with their renderings.

use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use vizflyt_rgbd::encode_jpeg;
use vizflyt_splat::format;
use vizflyt_twin::dataset::colmap;
use vizflyt_twin::train::Quality;
use vizflyt_twin::{Dataset, Options, Trainer};

use super::images::Pictures;
use crate::scene::progress::Progress;

/// Settings of the training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Schedule {
    pub(super) steps: u32,
    pub(super) splats: usize,
    pub(super) width_px: u32,
    pub(super) seed: u64,
}

/// Result of the stage, in addition to `scene.ply`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Trained {
    pub(super) photos: usize,
    pub(super) width_px: usize,
    pub(super) height_px: usize,
    pub(super) steps: u32,
    pub(super) splats: usize,
    /// Quality on held-out photos.
    pub(super) held_out: Option<HeldOut>,
    /// Some of the held-out photos, for the report.
    pub(super) samples: Vec<Sample>,
}

/// Mean quality over held-out photos.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct HeldOut {
    pub(super) photos: usize,
    pub(super) psnr_db: f64,
    pub(super) ssim: f64,
}

/// Held-out photo, stored as `photo-N.jpg` and `render-N.jpg` in the stage's folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Sample {
    pub(super) name: String,
    pub(super) psnr_db: f64,
}

/// Trains a scene with the model in `metric`.
pub(super) fn train(
    pictures: &Pictures,
    metric: &Path,
    schedule: Schedule,
    folder: &Path,
) -> Result<Trained> {
    let dataset = read(pictures, metric, schedule.width_px)?;
    let options = Options {
        steps: schedule.steps,
        splats: schedule.splats,
        seed: schedule.seed,
        hold_out: HOLD_OUT,
        ..Options::default()
    };
    let mut trainer = Trainer::new(&dataset, options);
    let mut progress = Progress::new("");
    while trainer.steps() < schedule.steps {
        let parts = trainer.step();
        let (step, splats) = (trainer.steps(), trainer.gaussians().len());
        progress.show(f64::from(step) / f64::from(schedule.steps), || {
            format!("step {step} of {}, {splats} splats, error {:.4}", schedule.steps, parts.l1)
        });
    }
    drop(progress);
    let held_out = trainer.judge();
    let splats = trainer.splats();
    format::write(folder.join("scene.ply"), &splats)?;
    let view = &dataset.photos[0].view;
    Ok(Trained {
        photos: dataset.photos.len(),
        width_px: view.width,
        height_px: view.height,
        steps: schedule.steps,
        splats: splats.len(),
        held_out: held_out.map(|Quality { photos, psnr_db, ssim }| HeldOut {
            photos,
            psnr_db,
            ssim,
        }),
        samples: samples(&dataset, &mut trainer, folder)?,
    })
}

/// Reads the photos of a metric model.
pub(super) fn read(pictures: &Pictures, metric: &Path, width_px: u32) -> Result<Dataset> {
    let model = colmap::read(&metric.join("sparse/0"))?;
    Ok(Dataset::of_model(&model, &pictures.folder, Some(width_px))?)
}

/// Writes some held-out photos and their renderings, evenly over the walk.
fn samples(dataset: &Dataset, trainer: &mut Trainer<'_>, folder: &Path) -> Result<Vec<Sample>> {
    let held_out = trainer.held_out();
    let count = held_out.len().min(SAMPLES);
    let mut samples = Vec::new();
    for k in 0..count {
        let photo = held_out[k * held_out.len() / count];
        let comparison = trainer.compare(photo);
        let photo = &dataset.photos[photo];
        let name = format!("{k}.jpg");
        let size = [photo.target.width, photo.target.height];
        write(&folder.join(format!("photo-{name}")), &photo.target.rgb, size)?;
        write(&folder.join(format!("render-{name}")), &comparison.rgb, size)?;
        samples.push(Sample { name: photo.name.clone(), psnr_db: comparison.psnr_db });
    }
    Ok(samples)
}

fn write(path: &Path, rgb: &[u8], size: [usize; 2]) -> Result<()> {
    let [width, height] = size.map(|side| side as u32);
    let mut bytes = Vec::new();
    encode_jpeg(rgb, width, height, JPEG_QUALITY, &mut bytes)
        .with_context(|| format!("cannot encode {}", path.display()))?;
    std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}

/// One of this number of photos is held out.
const HOLD_OUT: usize = 8;
/// Maximum number of samples in the report.
const SAMPLES: usize = 6;
const JPEG_QUALITY: u8 = 90;
