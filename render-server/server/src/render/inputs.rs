//! Inputs of the threads of this room.

use crate::flights::Flights;
use crate::poses::Localization;
use crate::render::Rendering;

/// State that rendering and measuring read and write.
#[derive(Debug)]
pub struct Inputs<'a, D> {
    /// Cameras, sensors, light and objects, and counters of images and readings.
    pub rendering: &'a Rendering,
    /// Poses of the vehicles.
    pub localization: &'a Localization,
    /// Flights under way.
    pub flights: &'a Flights,
    /// Demand for images.
    pub demand: &'a D,
}

impl<D> Clone for Inputs<'_, D> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<D> Copy for Inputs<'_, D> {}
