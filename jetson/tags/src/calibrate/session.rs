//! Calibration from images: detection, selection of views, and a second detection in the selected images.

use super::{Board, Calibrated, Calibrator, LensModel, Refused, ViewOutcome};
use crate::detect::{Detector, DetectorSettings};
use crate::family::TagFamily;
use crate::image::Gray;
use vizflyt_protocol::geometry::Intrinsics;

/// Collects images of a board until they determine the lens.
///
/// Corners are measured along edges that are straight behind the lens, but the lens is unknown at first. So the
/// selected images are kept, and detection runs again with the first lens.
pub struct Session {
    board: Board,
    model: LensModel,
    /// `None` for a checkerboard.
    detector: Option<Detector>,
    calibrator: Option<Calibrator>,
    kept: Vec<Gray>,
    /// Inner corners of a detected checkerboard that does not match the file.
    another: Option<(u32, u32)>,
}

impl Session {
    pub fn new(board: impl Into<Board>, model: LensModel) -> Self {
        let board = board.into();
        let detector = match &board {
            Board::Tags(layout) => {
                let mut families: Vec<TagFamily> =
                    layout.tags.iter().map(|tag| tag.family).collect();
                families.sort_unstable();
                families.dedup();
                Some(Detector::new(&families, DetectorSettings::default()))
            }
            Board::Checkerboard(_) => None,
        };
        Self { board, model, detector, calibrator: None, kept: Vec::new(), another: None }
    }

    /// Processes an image; `is_stream` as in [`Calibrator::add`].
    ///
    /// # Errors
    /// [`Refused`] if the image differs in size from the previous ones, or the board is invalid.
    pub fn take(&mut self, image: Gray, is_stream: bool) -> Result<ViewOutcome, Refused> {
        let size = [image.width_px(), image.height_px()];
        let calibrator = match &mut self.calibrator {
            Some(calibrator) => calibrator,
            none => none.insert(Calibrator::new(self.board.clone(), size)?),
        };
        if calibrator.size_px != size {
            let [width, height] = calibrator.size_px;
            let why = format!(
                "an image of {}x{} follows images of {width}x{height}",
                image.width_px(),
                image.height_px()
            );
            let add = vec!["calibrate with images of one size, the one that will be used".into()];
            return Err(Refused { why, add });
        }
        let rough = Intrinsics::from_horizontal_fov(size[0], size[1], 1.2);
        let verdict = match (&self.board, &mut self.detector) {
            (Board::Checkerboard(board), _) => {
                let verdict = calibrator.add_checkerboard(board.find(&image).as_deref(), is_stream);
                match verdict {
                    ViewOutcome::NoBoard => {
                        let another = board.find_another(&image);
                        self.another = self.another.or(another);
                        another.map_or(verdict, |(few, many)| ViewOutcome::AnotherBoard(few, many))
                    }
                    _ => verdict,
                }
            }
            (Board::Tags(_), Some(detector)) => {
                calibrator.add(&detector.search(&image, &rough, false), is_stream)
            }
            (Board::Tags(_), None) => ViewOutcome::TooFewTags,
        };
        if verdict == ViewOutcome::Kept && self.detector.is_some() {
            self.kept.push(image);
        }
        Ok(verdict)
    }

    /// Returns the collected views; `None` before the first image.
    pub fn progress(&self) -> Option<&Calibrator> {
        self.calibrator.as_ref()
    }

    /// Returns the lens.
    ///
    /// # Errors
    /// [`Refused`] if the images do not determine the lens well; its message lists the missing views.
    pub fn finish(mut self) -> Result<Calibrated, Refused> {
        let Some(calibrator) = self.calibrator else {
            return Err(Refused {
                why: "no image was taken".into(),
                add: vec!["show the board to the camera".into()],
            });
        };
        let first = calibrator.finish(self.model).map_err(|refused| match self.another {
            Some((few, many)) if calibrator.views() == 0 => {
                let why = ViewOutcome::AnotherBoard(few, many).to_string();
                Refused { why, add: Vec::new() }
            }
            _ => refused,
        })?;
        // Corners of a checkerboard are detected without a lens.
        let Some(detector) = &mut self.detector else { return Ok(first) };
        let mut again = Calibrator::new(self.board.clone(), calibrator.size_px)?;
        for image in &self.kept {
            again.add(&detector.search(image, &first.intrinsics, true), false);
        }
        // The second detection may miss a view that the first one barely found: then the first lens is returned.
        match again.finish(self.model) {
            Ok(second) if second.calibration.rms_px <= first.calibration.rms_px => Ok(second),
            _ => Ok(first),
        }
    }
}
