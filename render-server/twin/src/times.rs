//! Where the time of a training goes, part by part.

use std::fmt;
use std::time::Instant;

use serde::Serialize;
use vizflyt_splat::gpu::training::TrainingTimes;

/// How long the parts of a step took, on average of all steps. [ms]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Times {
    /// The photo's rendering.
    pub forward: f64,
    /// Its loss, and the derivative by the rendering.
    pub loss: f64,
    /// The derivative back to the Gaussians.
    pub backward: f64,
    /// The optimiser.
    pub adam: f64,
    /// Noise of the faint.
    pub wander: f64,
    /// The dead to where they are needed.
    pub relocate: f64,
    /// Of `forward` and `backward`, what a graphics card and the bus to it took; absent on the processor.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<TrainingTimes>,
}

impl Times {
    /// Returns the mean of what was added up over so many steps.
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

/// Adds what has passed since an instant, which then is now. [ms]
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
