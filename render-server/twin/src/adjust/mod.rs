//! Bundle adjustment over points, tags and other measurements: poses of structure from motion become metric poses.
//!
//! ```text
//! Capture --start--> a similarity to metres --solve--> poses, lens, points, tags in metres
//!                                              '------> sigma of scale and tilt; residuals of tags that were held out
//! ```
//! A similarity transform from tags cannot correct wrong poses. Here, the tags' corners constrain poses and lens
//! together with the points. The result includes its accuracy, which [`crate::verdict`] judges.

mod capture;
mod held_out;
mod known;
mod matrix;
mod normal;
mod project;
mod robust;
mod rolling;
mod solve;
mod start;
mod state;

#[cfg(test)]
pub(crate) mod synthetic;
#[cfg(test)]
mod tests;

use glam::DVec3;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use crate::align::{AlignError, Similarity};

pub use capture::{Capture, CaptureError, Image, Place, Sighting, Tag, TagSighting, Up};

/// Options of an adjustment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Estimate focal length, k1, k2 and principal point; not for calibrated lenses.
    pub refine_lens: bool,
    /// Hold out tags for validation. Each of a few groups takes about as long as the adjustment itself.
    pub hold_out: bool,
    /// Estimate the readout time of a rolling shutter; needs true image times.
    pub rolling: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { refine_lens: true, hold_out: true, rolling: true }
    }
}

/// An adjusted capture in metres.
#[derive(Clone, Debug, PartialEq)]
pub struct Adjusted {
    /// Metric quantities determined by measurements.
    pub known: Known,
    /// Approximate transform from `scene` to the adjusted frame: the one before the adjustment, without its
    /// deformation.
    pub world_from_scene: Similarity,
    /// Adjusted lens.
    pub lens: Intrinsics,
    /// Readout time of an image's rows; `None` if not estimated.
    pub readout: Option<Readout>,
    /// Pose of each image's middle row, in the order of the images. [m, world]
    pub world_from_cam: Vec<Pose<World, Cam>>,
    /// Points, in the order of the capture. [m, world]
    pub points_m: Vec<DVec3>,
    /// RMS reprojection error of the points, without outliers. [px]
    pub points_rms_px: f64,
    /// Fraction of sightings with an error above three sigmas.
    pub points_outliers: f64,
    /// RMS distance between measured positions and the cameras' tracked point; `None` without measured positions. [m]
    pub places_rms_m: Option<f64>,
    /// Tags, in the order of the capture; `None` if too few images saw the tag.
    pub tags: Vec<Option<TagResult>>,
    /// Distance by which corners are detected inside the tags, because white bleeds into black. More than half a pixel
    /// means a wrong print size instead. [px]
    pub inset_px: f64,
    /// Relative standard deviation of the scale; `None` if undetermined.
    pub scale_sigma: Option<f64>,
    /// Standard deviation of the vertical in the worse direction; `None` if undetermined. [rad]
    pub tilt_sigma_rad: Option<f64>,
    /// Number of iterations.
    pub rounds: usize,
}

/// Quantities determined by measurements outside structure from motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Known {
    /// Metric scale.
    pub scale: bool,
    /// Vertical.
    pub up: bool,
    /// Position and heading in the room.
    pub place: bool,
}

/// Readout time of a rolling shutter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Readout {
    /// Time from the first row's exposure to the last one's; negative for a phone held upside down. [s]
    pub seconds: f64,
    /// Standard deviation. [s]
    pub sigma_s: f64,
}

/// Residuals of a tag.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagResult {
    /// Number of images that saw the tag.
    pub sightings: usize,
    /// Number of images that saw the tag elsewhere: misread, or another tag with the same number.
    pub contradicting: usize,
    /// Adjusted corners. [m, world]
    pub corners_m: [DVec3; 4],
    /// RMS reprojection error of the agreeing sightings. [px]
    pub rms_px: f64,
    /// Result of the validation without this tag.
    pub held_out: Option<HeldOut>,
}

/// Position of a tag triangulated from images only, with poses adjusted by the other tags.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeldOut {
    /// Distance of the tag's centre from its measured position; `None` if unmeasured. [m]
    pub off_m: Option<f64>,
    /// Error of the centre per pixel of error in each image; large if few images saw the tag, or all from one side. [m]
    pub by_pixel_m: f64,
    /// Relative error of the edge length: 0 is exact.
    pub size_error: f64,
    /// RMS reprojection error. [px]
    pub rms_px: f64,
}

/// Why a capture cannot be adjusted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AdjustError {
    /// A value that is not finite or out of range, or a sighting of a missing point or tag.
    #[error("{0} is out of range")]
    BadNumber(&'static str),
    /// Too few images or points.
    #[error(
        "{images} placed images and {points} points are too little; at least 3 images that share 20 points are needed"
    )]
    TooLittle {
        /// Number of images.
        images: usize,
        /// Number of points seen by at least two images.
        points: usize,
    },
    /// Measured positions contradict structure from motion.
    #[error("measured positions of {what} contradict the images: {cause}")]
    Contradictory {
        /// Kind of the measured things.
        what: &'static str,
        /// Cause.
        cause: AlignError,
    },
    /// The normal equations have no solution.
    #[error(
        "the images do not determine where they were taken from; film again, walking sideways past what you film"
    )]
    Undetermined,
}

/// Adjusts a capture by robust least squares over all unknowns together.
///
/// The result does not depend on the number of threads.
///
/// # Errors
/// [`AdjustError`], which names the fault and what to film again.
pub fn adjust(capture: &Capture, options: Options) -> Result<Adjusted, AdjustError> {
    let (start, known) = start::start(capture)?;
    let mut state = state::State::new(capture, &start);
    let solved = solve::solve(capture, &mut state, options, known)?;
    let held_out = if options.hold_out {
        held_out::held_out(capture, &state, &solved, options, known)
    } else {
        vec![None; capture.tags.len()]
    };
    Ok(known::describe(capture, &state, &solved, known, &start, &held_out))
}
