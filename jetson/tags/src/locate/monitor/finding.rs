//! Errors of a lab's setup, as text.

use std::fmt::Write as _;

/// A detected error of the setup.
#[derive(Clone, Debug, PartialEq)]
pub enum Finding {
    /// Stamps of a camera's images are late; corrected.
    Late {
        /// Index of the camera.
        camera: usize,
        /// Delay of the stamps. [s]
        late_s: f64,
    },
    /// A camera with rolling shutter; corrected.
    RollingShutter {
        /// Index of the camera.
        camera: usize,
        /// Time from the first row to the last. [s]
        readout_s: f64,
    },
    /// A camera was moved since its survey.
    Moved {
        /// Index of the camera. If one of several was moved: all candidates.
        cameras: Vec<usize>,
        /// Displacement. [m]
        moved_m: f64,
        /// Rotation. [rad]
        turned_rad: f64,
    },
    /// The tags do not have the size in their layout.
    Scale {
        /// Ratio of the true size to the size in the layout.
        scale: f64,
    },
}

impl Finding {
    /// Returns a message with the correction.
    pub fn words(&self, names: &[&str]) -> String {
        let name = |camera: &usize| names.get(*camera).copied().unwrap_or("?");
        match self {
            Self::Late { camera, late_s } => {
                let late_ms = 1e3 * late_s;
                format!(
                    "{} stamps images {late_ms:.1} ms late (corrected): latency_ms in its file",
                    name(camera)
                )
            }
            Self::RollingShutter { camera, readout_s } => {
                format!(
                    "{} reads its rows over {:.1} ms (corrected)",
                    name(camera),
                    1e3 * readout_s
                )
            }
            Self::Moved { cameras, moved_m, turned_rad } => {
                let mut text = cameras.iter().map(name).collect::<Vec<_>>().join(" or ");
                // Writing to a string does not fail.
                let _ = write!(
                    text,
                    " camera moved by {:.1} cm and {:.1} degrees: survey again",
                    1e2 * moved_m,
                    turned_rad.to_degrees()
                );
                text
            }
            Self::Scale { scale } => format!(
                "the tags have {:.1} % of their layout's size: print at 100 %, or again with --bar-mm",
                1e2 * scale
            ),
        }
    }
}
