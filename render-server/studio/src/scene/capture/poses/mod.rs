//! The second stage: where pictures were taken from. Structure from motion is the work of others' programs; what is ours
//! is which pictures they compare, and that their word is not taken for it (`vizflyt_twin::verdict`).

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

/// What finds poses. Whatever it is, it leaves folders with COLMAP's files.
trait Finder {
    /// Returns its name and version, for reports.
    fn name(&self) -> &str;

    /// Finds poses of the pictures; leaves every model that it finds in a folder of its own below `job.models`.
    fn find(&self, job: &Job<'_>, progress: &mut dyn FnMut(Phase)) -> Result<()>;
}

/// What there is to find.
struct Job<'a> {
    /// Folder with the pictures.
    images: &'a Path,
    /// How many there are.
    count: usize,
    /// The lens, if it is known; then it is not refined.
    lens: Option<(&'static str, String)>,
    /// A file with the names of two pictures a line: those to compare.
    pairs: &'a Path,
    /// How many.
    pair_count: usize,
    /// Where the tool may write what it needs.
    folder: &'a Path,
    /// Where models go.
    models: &'a Path,
}

/// What the stage leaves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Poses {
    /// Who found them.
    pub(super) tool: String,
    /// Folders of models, that which places most pictures first.
    pub(super) models: Vec<Model>,
}

/// Pictures that were placed together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Model {
    pub(super) folder: PathBuf,
    pub(super) placed: usize,
}

/// Returns the models below a folder, that which places most pictures first.
///
/// # Errors
/// One that cannot be read.
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

/// Finds poses by a program that is installed here.
///
/// # Errors
/// None is installed, or it fails.
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
            "{} places no pictures: they share too little; film slowly, sideways past what has texture",
            finder.name()
        );
    }
    Ok(Poses { tool: finder.name().to_owned(), models })
}

/// Checks that poses can be found here at all.
///
/// # Errors
/// Nothing that finds poses is installed: what to install.
pub(super) fn check_installed(python: Option<&Path>) -> Result<()> {
    installed(python).map(drop)
}

/// Returns what is installed: pycolmap first, which `pip` brings in its newest version.
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
        "where the pictures were taken from is found by COLMAP, which is not installed; get one of these:\n  \
         python3 -m venv venv && venv/bin/pip install pycolmap     then give --python venv/bin/python\n  \
         apt-get install colmap                                    an older version, in the PATH\n\
         or give poses that exist already: --poses DATASET, of COLMAP or nerfstudio"
    )
}

/// Returns COLMAP's name for a lens, and its parameters as it reads them.
fn lens_text(k: &Intrinsics) -> (&'static str, String) {
    let (model, numbers) = colmap_files::parameters(k);
    (model, numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(","))
}

/// The lens that is estimated where none is known: one focal length, two terms of distortion.
const UNKNOWN_LENS: &str = "RADIAL";

/// Shows how far a finder is.
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
            // Each takes its own time.
            self.progress = Progress::new("");
        }
        let share = |done: usize, of: usize| done as f64 / of.max(1) as f64;
        match phase {
            Phase::Features { done, of } => {
                self.progress
                    .show(share(done, of), || format!("features of picture {done} of {of}"));
            }
            Phase::Matching { done, of } => {
                // A block that is begun is not done.
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
