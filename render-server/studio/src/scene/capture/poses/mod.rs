//! Third stage: estimates the camera poses. External programs do the structure from motion. This module selects the
//! pairs of pictures to compare; `vizflyt_twin::verdict` checks the result.

mod colmap;
mod given;
mod log;
mod pairs;
mod pycolmap;
mod tool;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
pub(super) use given::take_given;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_twin::dataset::colmap as colmap_files;

use self::log::Phase;
use self::tool::Tool;
use super::images::Pictures;
use super::prints::Seen;
use crate::scene::progress::Progress;

/// Program that estimates poses. Its results are folders with COLMAP's files.
trait Finder {
    /// Returns name and version for reports.
    fn name(&self) -> &str;

    /// Estimates the poses of the pictures. Writes each model into a separate folder below `job.models`.
    fn find(&self, job: &Job<'_>, progress: &mut dyn FnMut(Phase)) -> Result<()>;
}

/// Inputs and output folders of a program.
struct Job<'a> {
    /// Folder with the pictures.
    images: &'a Path,
    /// Number of pictures.
    count: usize,
    /// Calibrated lens: name and parameters of COLMAP. It is not refined.
    lens: Option<(&'static str, String)>,
    /// File with the pairs to compare: two names per line.
    pairs: &'a Path,
    /// Number of pairs.
    pair_count: usize,
    /// Folder for temporary files and the log.
    folder: &'a Path,
    /// Output folder for models.
    models: &'a Path,
}

/// Result of the stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Poses {
    /// Name and version of the program.
    pub(super) tool: String,
    /// Models; the one with the most placed pictures is first.
    pub(super) models: Vec<Model>,
}

/// Model of pictures in a common frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Model {
    pub(super) folder: PathBuf,
    pub(super) placed: usize,
}

/// Returns the models below a folder; the one with the most placed pictures is first.
///
/// # Errors
/// A model cannot be read.
fn models(folder: &Path) -> Result<Vec<Model>> {
    let mut models = Vec::new();
    for number in 0.. {
        let folder = folder.join(number.to_string());
        if !folder.is_dir() {
            break;
        }
        let placed = colmap_files::read(&folder)?.images.len();
        models.push(Model { folder, placed });
    }
    models.sort_by_key(|model| std::cmp::Reverse(model.placed));
    Ok(models)
}

/// Estimates poses with an installed program.
///
/// # Errors
/// No program is installed, or it fails.
pub(super) fn find(
    pictures: &Pictures,
    seen: &Seen,
    lens: Option<&Intrinsics>,
    python: Option<&Path>,
    folder: &Path,
) -> Result<Poses> {
    let finder = installed(python)?;
    let models_folder = folder.join("models");
    std::fs::create_dir_all(&models_folder)?;
    let pairs = pairs::of(pictures, seen);
    let list = folder.join("pairs.txt");
    let line = |&[a, b]: &[usize; 2]| {
        format!("{} {}\n", pictures.pictures[a].name, pictures.pictures[b].name)
    };
    std::fs::write(&list, pairs.iter().map(line).collect::<String>())?;
    let job = Job {
        images: &pictures.folder,
        count: pictures.pictures.len(),
        lens: lens.map(lens_text),
        pairs: &list,
        pair_count: pairs.len(),
        folder,
        models: &models_folder,
    };
    let mut phases = Phases::new(&job);
    finder.find(&job, &mut |phase| phases.show(phase))?;
    drop(phases);
    let models = models(&models_folder)?;
    if models.is_empty() {
        bail!(
            "{} cannot place any picture: they overlap too little; film slowly, sideways past textured surfaces",
            finder.name()
        );
    }
    Ok(Poses { tool: finder.name().to_owned(), models })
}

/// Checks that a program for poses is installed.
///
/// # Errors
/// No program is installed. The message explains the installation.
pub(super) fn check_installed(python: Option<&Path>) -> Result<()> {
    installed(python).map(drop)
}

/// Returns an installed program. pycolmap has precedence, because `pip` installs its newest version.
fn installed(python: Option<&Path>) -> Result<Box<dyn Finder>> {
    if let Some(python) = python {
        return Ok(Box::new(pycolmap::Pycolmap::open(python)?));
    }
    let in_environment =
        std::env::var_os("VIRTUAL_ENV").map(|venv| Path::new(&venv).join("bin/python"));
    let pythons = in_environment.into_iter().chain([PathBuf::from("python3")]);
    for python in pythons {
        if let Ok(found) = pycolmap::Pycolmap::open(&python) {
            return Ok(Box::new(found));
        }
    }
    if let Some(found) = colmap::Colmap::open(Path::new("colmap")) {
        return Ok(Box::new(found));
    }
    bail!(
        "camera poses are estimated by COLMAP, which is not installed; install one of these:\n  \
         python3 -m venv venv && venv/bin/pip install pycolmap     then give --python venv/bin/python\n  \
         apt-get install colmap                                    an older version, in the PATH\n\
         or give existing poses: --poses DATASET, of COLMAP or nerfstudio"
    )
}

/// Returns COLMAP's name and parameters of a lens.
fn lens_text(k: &Intrinsics) -> (&'static str, String) {
    let (model, numbers) = colmap_files::parameters(k);
    (model, numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(","))
}

/// Lens model to estimate if the lens is not calibrated: one focal length, two terms of distortion.
const UNKNOWN_LENS: &str = "RADIAL";

/// Progress display of a finder.
struct Phases {
    progress: Progress,
    phase: Option<std::mem::Discriminant<Phase>>,
    count: usize,
    pair_count: usize,
}

impl Phases {
    fn new(job: &Job<'_>) -> Self {
        let progress = Progress::new("");
        Self { progress, phase: None, count: job.count, pair_count: job.pair_count }
    }

    fn show(&mut self, phase: Phase) {
        let kind = std::mem::discriminant(&phase);
        if self.phase.replace(kind) != Some(kind) {
            // Each phase has a separate time estimate.
            self.progress = Progress::new("");
        }
        let share = |done: usize, of: usize| done as f64 / of.max(1) as f64;
        match phase {
            Phase::Features { done, of } => {
                self.progress
                    .show(share(done, of), || format!("features of picture {done} of {of}"));
            }
            Phase::Matching { done, of } => {
                // The current block is not finished.
                let done = done.saturating_sub(1);
                let pairs = done * self.pair_count / of.max(1);
                self.progress.show(share(done, of), || {
                    format!("compared {pairs} of {} pairs of pictures", self.pair_count)
                });
            }
            Phase::Placing { done } => {
                let of = self.count;
                self.progress.show(share(done, of), || format!("placed {done} of {of} pictures"));
            }
        }
    }
}
