//! A lens, from images of a board held before it: of tags, or a checkerboard.
//!
//! ```text
//! corners of a view -> Calibrator::add   kept, or why not (too few tags, too like another, moving)
//!                      Calibrator::wanted   where to hold the board next, in words
//!                      Calibrator::finish   focal lengths, middle, distortion; or what to add
//! images               Session              all of it, and a second look with the first lens
//! ```
//!
//! The start is closed: a homography per view, and of all of them the focal length (Zhang 2000, "A
//! flexible new technique for camera calibration", section 3.1, with the middle of the image as
//! principal point). Then [`crate::bundle`] finds lens and views together. Every fifth view is held
//! back: its corners judge a lens that never saw them.

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

/// Which lens is looked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensModel {
    /// Most lenses: [`Distortion::BrownConrady`] with k3 = 0.
    #[default]
    BrownConrady,
    /// Fisheyes of more than some 110 degrees: [`Distortion::KannalaBrandt`].
    KannalaBrandt,
}

/// What became of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ViewOutcome {
    /// It is used.
    Kept,
    /// Fewer than four of the board's tags are in it.
    TooFewTags,
    /// The checkerboard is not in it as a whole.
    NoBoard,
    /// Another checkerboard is, of so many inner corners each way.
    AnotherBoard(u32, u32),
    /// The board was nearly there before.
    KnownView,
    /// The board moves: its corners are smeared.
    Moving,
    /// There are as many views as help.
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

/// Why there is no lens, and what to add.
#[derive(Clone, Debug, PartialEq)]
pub struct Refused {
    /// What is wrong.
    pub why: String,
    /// What to do, each a sentence.
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

/// A lens and how well it is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibrated {
    /// The lens.
    pub intrinsics: Intrinsics,
    /// How well it explains the views.
    pub calibration: Calibration,
    /// One standard deviation of the focal lengths and the principal point. [px]
    pub sigma_px: [f64; 4],
}

/// One view of the board.
#[derive(Clone, Debug)]
struct BoardView {
    /// Corners on the board and in the image. [m, board] [px]
    corners: Vec<(DVec2, DVec2)>,
}

/// Gathers views of a board.
#[derive(Clone, Debug)]
pub struct Calibrator {
    board: Board,
    size_px: [u32; 2],
    views: Vec<BoardView>,
    /// Corners of the image before, on the board and in it.
    last: Vec<(DVec2, DVec2)>,
}

impl Calibrator {
    /// Begins, for images of this size; the board is flat, as `vizflyt tags print board` or `checkers` makes it.
    ///
    /// # Errors
    /// [`Refused`] if a tag of the board is tilted or raised.
    pub fn new(board: impl Into<Board>, [width_px, height_px]: [u32; 2]) -> Result<Self, Refused> {
        let board = board.into();
        board.check()?;
        Ok(Self { board, size_px: [width_px, height_px], views: Vec::new(), last: Vec::new() })
    }

    /// Returns how many views are kept.
    pub fn views(&self) -> usize {
        self.views.len()
    }

    /// Takes the tags of an image. With `is_stream`, images follow one another closely, and one whose
    /// corners moved since the one before is not kept.
    pub fn add(&mut self, detections: &[Detection], is_stream: bool) -> ViewOutcome {
        self.take(self.board.corners_of(detections), ViewOutcome::TooFewTags, is_stream)
    }

    /// Takes the corners of the checkerboard in an image, as [`Checkerboard::find`] returns them; none if it is not
    /// there. `is_stream` as for [`Self::add`].
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

    /// Takes corners on the board and in the image; `absent` means that there are too few.
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

    /// Returns where corners were seen and how the board was tilted, by a rough lens.
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

    /// Returns where to hold the board next, each a sentence; nothing if it has been everywhere.
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
    /// [`Refused`] for a set of views that does not determine one well: its message lists what to add.
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
            why: "these views lead to no lens".into(),
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

    /// Returns a lens to start from: the focal length of all homographies, and no distortion.
    fn rough(&self, model: LensModel) -> Intrinsics {
        let [width_px, height_px] = self.size_px;
        let mut lens = Intrinsics::from_horizontal_fov(width_px, height_px, 1.2);
        let middle = DVec2::new(lens.cx_px, lens.cy_px);
        let planes: Vec<Plane> =
            self.views.iter().filter_map(|view| Plane::fit(&view.corners)).collect();
        if let Some(focal_px) = homography::focal_px(&planes, middle) {
            // From a telephoto to a fisheye: what lies outside is a degenerate set.
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

/// Finds the poses of views, and the lens if it is free.
fn adjust(
    views: &[&BoardView],
    lens: Intrinsics,
    is_free: bool,
) -> Option<(Bundle, crate::bundle::Solution)> {
    // A rough lens puts corners far off; the loss must not cut them away before the lens has bent.
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

/// Returns the root mean square distance of all corners, misread ones too.
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

/// Refuses a lens that would mislead.
fn check(found: &Calibrated, model: LensModel) -> Result<(), Refused> {
    let refuse = |why: String, add: &str| Err(Refused { why, add: vec![add.into()] });
    let Calibration { rms_px, held_out_rms_px, .. } = found.calibration;
    let other = match model {
        LensModel::BrownConrady => "if the lens is a fisheye, try that model",
        LensModel::KannalaBrandt => "if the lens is no fisheye, try the other model",
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
             others {rms_px:.2} px: the lens fits its own views alone"
        );
        return refuse(why, "add views, above all at the image's edges");
    }
    let share = found.sigma_px[0] / found.intrinsics.fx_px;
    if !(share <= GREATEST_FOCAL_SHARE) {
        let why = format!("the focal length is known to {:.1} % only", 100.0 * share);
        return refuse(why, "tilt the board more, by up to 45 degrees, to all sides");
    }
    if found.intrinsics.validate().is_err() {
        return refuse(format!("the lens found is none: {:?}", found.intrinsics), other);
    }
    Ok(())
}

/// Whether no corner moved by more than those of a still image scatter.
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

/// Whether corners that both views have are this far apart, on average; or none are in both.
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

/// Returns the pose whose axes these are.
fn rotation(x: DVec3, y: DVec3) -> DQuat {
    let x = x.normalize();
    let z = x.cross(y).normalize();
    DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize()
}

/// Views that a set must have: twelve used, three held back.
const MIN_VIEWS: usize = 15;
/// More views cost time and add nothing.
const MAX_VIEWS: usize = 80;
/// One view in so many is held back.
const HELD_OUT: usize = 5;
/// Views are alike if their corners are nearer than this. [share of the image's width]
const NOVELTY: f64 = 0.02;
/// Corners of a board held still scatter less than this from image to image. [px]
const STILL_PX: f64 = 1.5;
/// Corners count half at this distance, once the lens is nearly right. [px]
const LOSS_PX: f64 = 2.0;
/// Corners count half at this distance at first. [px]
const FIRST_LOSS_PX: f64 = 40.0;
/// Corners of a good set are within 0.1 to 0.4 px; a bent board or blur makes more. [px]
const GREATEST_RMS_PX: f64 = 1.0;
/// 0.5 % is 2 cm at 4 m.
const GREATEST_FOCAL_SHARE: f64 = 0.005;

#[cfg(test)]
mod tests;
