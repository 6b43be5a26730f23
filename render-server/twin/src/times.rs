//! Training time by part.

use std::fmt;
use std::time::Instant;

use serde::Serialize;
use vizflyt_splat::gpu::training::TrainingTimes;

/// Mean time of each part of a training step [ms].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Times {
    /// Rendering of the photo's view.
    pub forward: f64,
    /// Loss and its derivative with respect to the rendering.
    pub loss: f64,
    /// Derivative with respect to the Gaussians.
    pub backward: f64,
    /// Optimiser step.
    pub adam: f64,
    /// Noise on the means of faint Gaussians.
    pub wander: f64,
    /// Relocation of dead Gaussians.
    pub relocate: f64,
    /// Share of `forward` and `backward` on a graphics card and its bus; absent on the processor.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<TrainingTimes>,
}

impl Times {
    /// Returns the mean of sums over a number of steps.
    pub(crate) fn mean(&self, steps: u32) -> Self {
        let share = 1.0 / f64::from(steps.max(1));
        Self {
            forward: self.forward * share,
            loss: self.loss * share,
            backward: self.backward * share,
            adam: self.adam * share,
            wander: self.wander * share,
            relocate: self.relocate * share,
            device: self.device.map(|times| times.times(share)),
        }
    }
}

/// Adds the time since an instant to a sum [ms], and sets the instant to the present.
pub(crate) fn lap(to: &mut f64, since: &mut Instant) {
    let now = Instant::now();
    *to += (now - *since).as_secs_f64() * 1e3;
    *since = now;
}

impl fmt::Display for Times {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { forward, loss, backward, adam, wander, relocate, device } = self;
        write!(
            out,
            "forward {forward:.2}, loss {loss:.2}, backward {backward:.2}, Adam {adam:.2}, wander {wander:.2}, \
             relocate {relocate:.2}"
        )?;
        if let Some(device) = device {
            write!(out, "; of forward and backward: {device}")?;
        }
        Ok(())
    }
}
