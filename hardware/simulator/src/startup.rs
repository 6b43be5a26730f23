//! How long the autopilot takes from power to flight.

/// The autopilot's start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Startup {
    /// As ArduCopter's: the estimator aligns after power-on, the position counts after a second of external
    /// navigation, and a state is reported when its stream is due.
    #[default]
    Realistic,
    /// For flights that start at once: the vehicle has stood powered before the start, the position counts
    /// after a few poses, and a change that a companion waits for is reported at once.
    Quick,
}

impl Startup {
    /// Time for which vision must have been fused before the position counts. [s]
    pub(crate) fn settle_s(self) -> f64 {
        match self {
            Self::Realistic => 1.0,
            // Ten poses at the filter's 50 Hz.
            Self::Quick => 0.2,
        }
    }
}
