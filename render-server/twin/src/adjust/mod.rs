//! Structure from motion's poses -> metric poses: bundle adjustment over points, tags and what else is known of the room.
//!
//! ```text
//! Capture --start--> a similarity to metres --solve--> poses, lens, points, tags in metres
//!                                              '------> sigma of scale and tilt; residuals of tags that were held out
//! ```
//! Tags cannot mend wrong poses from outside, by a similarity alone: here their corners pull at poses and lens together
//! with the points. What comes out says how well it is known, for [`crate::verdict`] to judge.

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

/// How to adjust.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Whether focal length, k1, k2 and principal point are found too: not for a lens that was calibrated.
    pub refine_lens: bool,
    /// Whether tags are held out, which takes about as long again for each of a few parts.
    pub hold_out: bool,
    /// Whether rows may have been exposed one after the other: by images whose times are true.
    pub rolling: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { refine_lens: true, hold_out: true, rolling: true }
    }
}

/// A capture in metres.
#[derive(Clone, Debug, PartialEq)]
pub struct Adjusted {
    /// What is metric about it.
    pub known: Known,
    /// Takes `scene` about to where the images now are: what was there before the adjustment bent it.
    pub world_from_scene: Similarity,
    /// The lens.
    pub lens: Intrinsics,
    /// How long it took to expose all rows of an image; `None` if that was not asked.
    pub readout: Option<Readout>,
    /// Poses, of an image's middle row, in the order of the images. [m, world]
    pub world_from_cam: Vec<Pose<World, Cam>>,
    /// Points, in the order of the capture's. [m, world]
    pub points_m: Vec<DVec3>,
    /// How far points are from where images saw them, root mean square without outliers. [px]
    pub points_rms_px: f64,
    /// Sightings of points that fit worse than three sigmas, as a share.
    pub points_outliers: f64,
    /// How far tracked points are from where the cameras have them, root mean square; `None` without. [m]
    pub places_rms_m: Option<f64>,
    /// Tags, in the order of the capture's; `None` of one that too few images saw.
    pub tags: Vec<Option<TagResult>>,
    /// How far inside tags their corners are found: white bleeds into black. More than half a pixel is no bleeding, but
    /// prints of another size. [px]
    pub inset_px: f64,
    /// Of the scale, as a share of it, one sigma; `None` if nothing tells it.
    pub scale_sigma: Option<f64>,
    /// Of the vertical, the worse direction, one sigma; `None` if nothing tells it. [rad]
    pub tilt_sigma_rad: Option<f64>,
    /// Rounds until nothing changed.
    pub rounds: usize,
}

/// What outside knowledge tells of a capture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Known {
    /// Lengths.
    pub scale: bool,
    /// The vertical.
    pub up: bool,
    /// The place in the room, heading too.
    pub place: bool,
}

/// How long rows take.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Readout {
    /// From the first row's exposure to the last one's; negative of a phone held upside down. [s]
    pub seconds: f64,
    /// One sigma. [s]
    pub sigma_s: f64,
}

/// How a tag fits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagResult {
    /// Images that saw it.
    pub sightings: usize,
    /// Images that saw it somewhere else: misread, or another tag of the same number.
    pub contradicting: usize,
    /// Where its corners are. [m, world]
    pub corners_m: [DVec3; 4],
    /// How far they are from where images saw them, root mean square of sightings that agree. [px]
    pub rms_px: f64,
    /// What it says where it had no say.
    pub held_out: Option<HeldOut>,
}

/// Where a tag is by images alone, placed by all other tags.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeldOut {
    /// From where it was measured to be: its middle. `None` if that was not measured. [m]
    pub off_m: Option<f64>,
    /// How far its middle may be off by a pixel in each image that saw it: much, where few saw it, or from one side. [m]
    pub by_pixel_m: f64,
    /// Its edges, as a share of what they were measured to be, less 1.
    pub size_error: f64,
    /// How far it is from where images saw it, root mean square. [px]
    pub rms_px: f64,
}

/// Why a capture could not be adjusted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AdjustError {
    /// A number that is none, or a sighting of what is not there.
    #[error("{0} is not a number that can be meant")]
    BadNumber(&'static str),
    /// Too little to adjust.
    #[error(
        "{images} placed images and {points} points are too little; at least 3 images that share 20 points are needed"
    )]
    TooLittle {
        /// Images.
        images: usize,
        /// Points that at least two of them saw.
        points: usize,
    },
    /// Measured places contradict structure from motion.
    #[error("where {what} are contradicts where the images see them: {cause}")]
    Contradictory {
        /// Tags or places.
        what: &'static str,
        /// How.
        cause: AlignError,
    },
    /// The normal equations have no solution.
    #[error(
        "the images do not determine where they were taken from; film again, walking sideways past what you film"
    )]
    Undetermined,
}

/// Adjusts a capture: robust least squares over everything at once.
///
/// Deterministic: the same on any number of threads.
///
/// # Errors
/// [`AdjustError`] says what is wrong with the capture, and what to film again.
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
