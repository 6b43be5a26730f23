//! Lens calibration from images of a board of tags or a checkerboard.
//!
//! ```text
//! corners of a view -> Calibrator::add      kept, or rejected (too few tags, similar view, motion)
//!                      Calibrator::wanted   missing views, as instructions
//!                      Calibrator::finish   focal lengths, principal point, distortion; or missing views
//! images            -> Session              all steps, and a second detection with the first lens
//! ```
//!
//! The initial lens has a closed form: a homography per view, and the focal length from all of them (Zhang 2000, "A
//! flexible new technique for camera calibration", section 3.1, with the middle of the image as principal point). Then
//! [`crate::bundle`] estimates lens and views together. Every fifth view is held back to validate the lens.

mod board;
mod coverage;
mod homography;
mod session;

pub use board::Board;
pub use coverage::Coverage;
pub use session::Session;

use std::fmt;

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics};

use crate::bundle::{Bundle, CornerObservation, Parameter, Rigid};
use crate::camera::Calibration;
use crate::detection::Detection;
use homography::Plane;

/// Distortion model of the lens.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensModel {
    /// For most lenses: [`Distortion::BrownConrady`] with k3 = 0.
    #[default]
    BrownConrady,
    /// For fisheyes of more than about 110 degrees: [`Distortion::KannalaBrandt`].
    KannalaBrandt,
}

/// Result of adding a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ViewOutcome {
    /// The view is used.
    Kept,
    /// The view shows fewer than four of the board's tags.
    TooFewTags,
    /// The view does not show the complete checkerboard.
    NoBoard,
    /// The view shows another checkerboard, with this number of inner corners in each direction.
    AnotherBoard(u32, u32),
    /// The view is similar to an earlier one.
    KnownView,
    /// The board moves: its corners are blurred.
    Moving,
    /// The maximum number of views is reached.
    Enough,
}

impl fmt::Display for ViewOutcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Self::AnotherBoard(few, many) = self {
            return write!(
                f,
                "this checkerboard has {few} by {many} inner corners: correct columns and rows in the board's file"
            );
        }
        f.write_str(match self {
            Self::Kept => "kept",
            Self::TooFewTags => "show at least four tags of the board",
            Self::NoBoard | Self::AnotherBoard(..) => "show the whole checkerboard",
            Self::KnownView => "the board was there before; move or tilt it",
            Self::Moving => "hold the board still",
            Self::Enough => "enough views",
        })
    }
}

/// Reason for a rejected calibration, and the correction.
#[derive(Clone, Debug, PartialEq)]
pub struct Refused {
    pub why: String,
    /// Corrections, one instruction each.
    pub add: Vec<String>,
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.why)?;
        for what in &self.add {
            write!(f, "; {what}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Refused {}

/// A lens with its accuracy.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibrated {
    pub intrinsics: Intrinsics,
    /// Residuals of the views.
    pub calibration: Calibration,
    /// Standard deviations of the focal lengths and the principal point. [px]
    pub sigma_px: [f64; 4],
}

/// One view of the board.
#[derive(Clone, Debug)]
struct BoardView {
    /// Corners on the board and in the image. [m, board] [px]
    corners: Vec<(DVec2, DVec2)>,
}

/// Collects views of a board and computes the lens.
#[derive(Clone, Debug)]
pub struct Calibrator {
    board: Board,
    size_px: [u32; 2],
    views: Vec<BoardView>,
    /// Corners of the previous image, on the board and in the image.
    last: Vec<(DVec2, DVec2)>,
}

impl Calibrator {
    /// Makes a calibrator for images of this size. The board is flat, as printed by `vizflyt tags print board` or
    /// `checkers`.
    ///
    /// # Errors
    /// [`Refused`] if a tag of the board is tilted or raised.
    pub fn new(board: impl Into<Board>, [width_px, height_px]: [u32; 2]) -> Result<Self, Refused> {
        let board = board.into();
        board.check()?;
        Ok(Self { board, size_px: [width_px, height_px], views: Vec::new(), last: Vec::new() })
    }

    /// Returns the number of kept views.
    pub fn views(&self) -> usize {
        self.views.len()
    }

    /// Adds the tags of an image. With `is_stream`, images are consecutive, and an image whose corners moved since the
    /// previous one is not kept.
    pub fn add(&mut self, detections: &[Detection], is_stream: bool) -> ViewOutcome {
        self.take(self.board.corners_of(detections), ViewOutcome::TooFewTags, is_stream)
    }

    /// Adds the corners of the checkerboard in an image, from [`Checkerboard::find`]; `None` if it was not found.
    /// `is_stream` as in [`Self::add`].
    ///
    /// [`Checkerboard::find`]: crate::checkerboard::Checkerboard::find
    pub fn add_checkerboard(
        &mut self,
        corners_px: Option<&[DVec2]>,
        is_stream: bool,
    ) -> ViewOutcome {
        let corners = corners_px.map_or_else(Vec::new, |corners| self.board.checkerboard(corners));
        self.take(corners, ViewOutcome::NoBoard, is_stream)
    }

    /// Adds corners on the board and in the image. Returns `absent` if there are too few.
    fn take(
        &mut self,
        corners: Vec<(DVec2, DVec2)>,
        absent: ViewOutcome,
        is_stream: bool,
    ) -> ViewOutcome {
        let before = std::mem::replace(&mut self.last, corners.clone());
        if self.views.len() >= MAX_VIEWS {
            return ViewOutcome::Enough;
        }
        if corners.len() < self.board.least_corners() {
            return absent;
        }
        if is_stream && !is_still(&before, &corners) {
            return ViewOutcome::Moving;
        }
        let view = BoardView { corners };
        let novelty_px = NOVELTY * f64::from(self.size_px[0]);
        if self.views.iter().any(|known| !differs(known, &view, novelty_px)) {
            return ViewOutcome::KnownView;
        }
        self.views.push(view);
        ViewOutcome::Kept
    }

    /// Returns the coverage of the image by corners and the tilts of the board, computed with a rough lens.
    pub fn coverage(&self) -> Coverage {
        let mut coverage = Coverage::new(self.size_px);
        let rough = self.rough(LensModel::BrownConrady);
        for view in &self.views {
            coverage.corners(view.corners.iter().map(|&(_, pixel)| pixel));
            if let Some(pose) = Plane::fit(&view.corners).and_then(|plane| plane.pose(&rough)) {
                coverage.tilt(pose.q * DVec3::Z);
            }
        }
        coverage
    }

    /// Returns instructions for missing views; empty if none are missing.
    pub fn wanted(&self) -> Vec<String> {
        let mut wanted = self.coverage().wanted();
        if self.views.len() < MIN_VIEWS {
            wanted.push(format!("show {} more views of the board", MIN_VIEWS - self.views.len()));
        }
        wanted
    }

    /// Returns the lens.
    ///
    /// # Errors
    /// [`Refused`] if the views do not determine the lens well; its message lists the missing views.
    pub fn finish(&self, model: LensModel) -> Result<Calibrated, Refused> {
        let wanted = self.wanted();
        if !wanted.is_empty() {
            let why = format!("{} views do not determine this lens", self.views.len());
            return Err(Refused { why, add: wanted });
        }
        let held_out = |i: usize| i % HELD_OUT == HELD_OUT - 1;
        let pick = |want: bool| -> Vec<&BoardView> {
            let views = self.views.iter().enumerate();
            views.filter(|(i, _)| held_out(*i) == want).map(|(_, view)| view).collect()
        };
        let (used, held) = (pick(false), pick(true));
        let undetermined = || Refused {
            why: "the solver found no lens for these views".into(),
            add: vec![
                "check that the board's layout file is the one that was printed".into(),
                "tilt the board more, by up to 45 degrees, to all sides".into(),
            ],
        };
        let rough = self.rough(model);
        let (mut bundle, solution) = adjust(&used, rough, true).ok_or_else(undetermined)?;
        let (lens, _) = bundle.lenses.swap_remove(0);
        let (held_bundle, _) = adjust(&held, lens, false).ok_or_else(undetermined)?;
        let calibration = Calibration {
            rms_px: rms_px(&bundle, lens),
            held_out_rms_px: rms_px(&held_bundle, lens),
            images: used.len() as u32,
        };
        let sigma = solution.lens_sigma(0);
        let sigma_px = [sigma[0], sigma[1], sigma[2], sigma[3]];
        let calibrated = Calibrated { intrinsics: lens, calibration, sigma_px };
        check(&calibrated, model)?;
        Ok(calibrated)
    }

    /// Returns an initial lens: the focal length from all homographies, without distortion.
    fn rough(&self, model: LensModel) -> Intrinsics {
        let [width_px, height_px] = self.size_px;
        let mut lens = Intrinsics::from_horizontal_fov(width_px, height_px, 1.2);
        let middle = DVec2::new(lens.cx_px, lens.cy_px);
        let planes: Vec<Plane> =
            self.views.iter().filter_map(|view| Plane::fit(&view.corners)).collect();
        if let Some(focal_px) = homography::focal_px(&planes, middle) {
            // From a fisheye to a telephoto lens; values outside come from a degenerate set.
            let width = f64::from(width_px);
            let focal_px = focal_px.clamp(0.2 * width, 10.0 * width);
            (lens.fx_px, lens.fy_px) = (focal_px, focal_px);
        }
        lens.distortion = match model {
            LensModel::BrownConrady => {
                Distortion::BrownConrady { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 }
            }
            LensModel::KannalaBrandt => {
                Distortion::KannalaBrandt { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 }
            }
        };
        lens
    }
}

/// Estimates the poses of views, and the lens if `is_free`.
fn adjust(
    views: &[&BoardView],
    lens: Intrinsics,
    is_free: bool,
) -> Option<(Bundle, crate::bundle::Solution)> {
    // A rough lens has large residuals; the loss must not suppress them before the distortion has been estimated.
    let mut bundle =
        Bundle { lenses: vec![(lens, is_free)], loss_px: FIRST_LOSS_PX, ..Bundle::default() };
    let board = bundle.pose(Rigid::IDENTITY, Parameter::Fixed);
    for view in views {
        let Some(pose) = Plane::fit(&view.corners).and_then(|plane| plane.pose(&lens)) else {
            continue;
        };
        let left = bundle.pose(pose, Parameter::View);
        bundle.seen.extend(view.corners.iter().map(|&(on_board, pixel)| CornerObservation {
            lens: 0,
            left,
            right: board,
            point_m: on_board.extend(0.0),
            pixel,
        }));
    }
    bundle.solve()?;
    bundle.loss_px = LOSS_PX;
    let solution = bundle.solve()?;
    Some((bundle, solution))
}

/// Returns the root mean square residual of all corners, including misread ones.
fn rms_px(bundle: &Bundle, lens: Intrinsics) -> f64 {
    let mut bundle = bundle.clone();
    bundle.lenses = vec![(lens, false)];
    let squares: Vec<f64> = bundle
        .seen
        .iter()
        .filter_map(|seen| bundle.residual(seen))
        .map(DVec2::length_squared)
        .collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

/// Rejects an inaccurate lens.
fn check(found: &Calibrated, model: LensModel) -> Result<(), Refused> {
    let refuse = |why: String, add: &str| Err(Refused { why, add: vec![add.into()] });
    let Calibration { rms_px, held_out_rms_px, .. } = found.calibration;
    let other = match model {
        LensModel::BrownConrady => "if the lens is a fisheye, try that model",
        LensModel::KannalaBrandt => "if the lens is not a fisheye, try the other model",
    };
    if !(rms_px <= GREATEST_RMS_PX) {
        let why = format!("corners are {rms_px:.2} px off, more than {GREATEST_RMS_PX} px");
        let add =
            format!("glue the board on something flat, hold it still, use more light; {other}");
        return refuse(why, &add);
    }
    if !(held_out_rms_px <= 1.5 * rms_px + 0.1) {
        let why = format!(
            "corners of views that were held back are {held_out_rms_px:.2} px off, those of the \
             others {rms_px:.2} px: the lens fits only its own views"
        );
        return refuse(why, "add views, above all at the image's edges");
    }
    let share = found.sigma_px[0] / found.intrinsics.fx_px;
    if !(share <= GREATEST_FOCAL_SHARE) {
        let why = format!("the focal length is uncertain by {:.1} %", 100.0 * share);
        return refuse(why, "tilt the board more, by up to 45 degrees, to all sides");
    }
    if found.intrinsics.validate().is_err() {
        return refuse(format!("the estimated lens is invalid: {:?}", found.intrinsics), other);
    }
    Ok(())
}

/// Returns whether no corner moved by more than the scatter of a still image.
fn is_still(before: &[(DVec2, DVec2)], now: &[(DVec2, DVec2)]) -> bool {
    let mut common = 0;
    for (on_board, pixel) in now {
        let Some((_, old)) = before.iter().find(|(point, _)| point == on_board) else { continue };
        common += 1;
        if pixel.distance(*old) > STILL_PX {
            return false;
        }
    }
    common > 0
}

/// Returns whether the mean distance of common corners is above the limit, or no corner is common.
fn differs(a: &BoardView, b: &BoardView, least_px: f64) -> bool {
    let (mut sum, mut count) = (0.0, 0);
    for (on_board, pixel) in &a.corners {
        if let Some((_, other)) = b.corners.iter().find(|(point, _)| point == on_board) {
            sum += pixel.distance(*other);
            count += 1;
        }
    }
    count == 0 || sum > least_px * f64::from(count)
}

/// Returns the rotation with these x and y axes.
fn rotation(x: DVec3, y: DVec3) -> DQuat {
    let x = x.normalize();
    let z = x.cross(y).normalize();
    DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize()
}

/// Minimum number of views: twelve used, three held back.
const MIN_VIEWS: usize = 15;
/// Maximum number of views; more cost time without a gain in accuracy.
const MAX_VIEWS: usize = 80;
/// Every fifth view is held back.
const HELD_OUT: usize = 5;
/// Views with a smaller mean distance of corners are similar. [share of the image's width]
const NOVELTY: f64 = 0.02;
/// Maximum motion of corners between images of a still board. [px]
const STILL_PX: f64 = 1.5;
/// Distance at which a corner has half the weight, in the final adjustment. [px]
const LOSS_PX: f64 = 2.0;
/// Distance at which a corner has half the weight, in the first adjustment. [px]
const FIRST_LOSS_PX: f64 = 40.0;
/// Maximum RMS error. Good sets have 0.1 to 0.4 px; a bent board or blur causes more. [px]
const GREATEST_RMS_PX: f64 = 1.0;
/// Maximum relative sigma of the focal length: 0.5 % is 2 cm at 4 m.
const GREATEST_FOCAL_SHARE: f64 = 0.005;

#[cfg(test)]
mod tests;
