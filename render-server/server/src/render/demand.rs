//! Demand of the consumers of images.

use std::time::Duration;

use vizflyt_arena::config::MAX_VEHICLES;

/// Demand for images. The stream room implements it, so that rendering is independent of the transport.
pub trait Demand {
    /// Waits at most `timeout` for demand for images; returns the vehicles with demand.
    fn wait_for_interest(&self, timeout: Duration) -> [bool; MAX_VEHICLES];

    /// Returns whether a page wants previews.
    fn has_viewers(&self) -> bool;

    /// Returns the divisor of image width and height for a vehicle's link.
    fn shrink(&self, vehicle: usize) -> u32;

    /// Returns the time from the start of rendering until the plugin receives an image; `None` if unknown. [s]
    fn seen_after_s(&self, vehicle: usize) -> Option<f64>;

    /// Counts an image rendered during a runtime's flight.
    fn count_rendered(&self, vehicle: usize, camera: usize);
}
