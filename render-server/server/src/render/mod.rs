//! What cameras and other sensors see: newest motions in, rendered ticks and readings out.
//!
//! ```text
//! in   the newest motions of all vehicles, from `poses`; the demand for images, from `stream`
//! out  rendered ticks (RGB, depth, object ids), to the encode thread and then to the previews;
//!      readings of other sensors, to sessions and the page
//! ```
//! Imports `scene`, `poses` and `flights`; `stream` states its demand through [`demand::Demand`].

pub mod cameras;
pub mod demand;
pub mod dynamic_objects;
pub mod environment;
pub mod imaging;
pub mod inputs;
pub mod rendered;
mod renderer;
pub mod schedule;
pub mod sensors;
pub mod thread;

use std::sync::Mutex;
use std::sync::atomic::AtomicU64;

use vizflyt_arena::pose::Predict;

use self::cameras::Cameras;
use self::dynamic_objects::DynamicObjects;
use self::environment::Environment;
pub use self::renderer::{DetailKind, RendererInfo, RendererKind, choose, open_packed};
use self::sensors::Sensors;
use crate::timing::StageDurations;

/// What is rendered, and how.
#[derive(Debug, Default)]
pub struct Rendering {
    /// The cameras of each vehicle, at its index.
    pub cameras: Vec<Cameras>,
    /// The sensors beside the cameras of each vehicle, at its index.
    pub sensors: Vec<Sensors>,
    /// Light and weather.
    pub environment: Environment,
    /// What is where by chance in the weather: the same for all images.
    pub seed: u64,
    /// Moving objects, and the vehicles as the others see them.
    pub dynamic_objects: DynamicObjects,
    /// The instant that images show.
    pub predict: Predict,
    /// Which renderer renders, and why; another one may take over in flight.
    pub renderer: Mutex<RendererInfo>,
    /// Rendering all cameras of a tick.
    pub durations: StageDurations,
    /// Ticks rendered.
    pub ticks: AtomicU64,
    /// Ticks rendered that were replaced by the next one before anyone took them.
    pub ticks_skipped: AtomicU64,
}
