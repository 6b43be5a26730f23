//! Time from power-on of the autopilot until it can fly.

/// Start-up behaviour of the autopilot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Startup {
    /// Like ArduCopter: the estimator aligns after power-on, the position is valid after a second of external
    /// navigation, and a state is reported when its stream is due.
    #[default]
    Realistic,
    /// For flights that start at once: the vehicle was powered before the start, the position is valid after a few
    /// poses, and state changes that a companion waits for are reported at once.
    Quick,
}

impl Startup {
    /// Time of fused vision until the position is valid [s].
    pub(crate) fn settle_s(self) -> f64 {
        match self {
            Self::Realistic => 1.0,
            // Ten poses at the filter's 50 Hz.
            Self::Quick => 0.2,
        }
    }
}
