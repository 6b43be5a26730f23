//! What the consumers of images want of the render thread.

use std::time::Duration;

use vizflyt_arena::config::MAX_VEHICLES;

/// The demand for images; the stream room implements it, so that rendering knows no transport.
pub trait Demand {
    /// Waits at most `timeout` until someone wants images; returns of which vehicles.
    fn wait_for_interest(&self, timeout: Duration) -> [bool; MAX_VEHICLES];

    /// Whether previews are wanted by a page.
    fn has_viewers(&self) -> bool;

    /// Returns the divisor of image width and height that a vehicle's link asks for.
    fn shrink(&self, vehicle: usize) -> u32;

    /// Returns how long after the start of rendering a plugin gets an image; `None` if not known.
    /// [s]
    fn seen_after_s(&self, vehicle: usize) -> Option<f64>;

    /// Counts an image that was rendered while a runtime flies.
    fn count_rendered(&self, vehicle: usize, camera: usize);
}
