//! What is wrong with a lab, in words.

use std::fmt::Write as _;

/// What is wrong, as people should know it.
#[derive(Clone, Debug, PartialEq)]
pub enum Finding {
    /// A camera's images are stamped late; corrected. [s]
    Late {
        /// Index of the camera.
        camera: usize,
        /// How much. [s]
        late_s: f64,
    },
    /// A camera reads its rows one after the other; corrected. [s]
    RollingShutter {
        /// Index of the camera.
        camera: usize,
        /// From the first row to the last. [s]
        readout_s: f64,
    },
    /// A camera is not where its file has it.
    Moved {
        /// Index of the camera; of several, one of which was moved, all.
        cameras: Vec<usize>,
        /// How far. [m]
        moved_m: f64,
        /// And how far turned. [rad]
        turned_rad: f64,
    },
    /// Tags are of another size than their layout says.
    Scale {
        /// Their true size in units of the layout's.
        scale: f64,
    },
}

impl Finding {
    /// Returns it in words, with what to do.
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
