//! Rendering of cameras and sensors: newest motions in, rendered ticks and readings out.
//!
//! ```text
//! in   the newest motions of all vehicles, from `poses`; the demand for images, from `stream`
//! out  rendered ticks (RGB, depth, object ids), to the encode thread and then to the previews;
//!      readings of other sensors, to sessions and the page
//! ```
//! Imports `scene`, `poses` and `flights`; `stream` implements [`demand::Demand`].

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

/// State of rendering.
#[derive(Debug, Default)]
pub struct Rendering {
    /// Cameras by index of the vehicle.
    pub cameras: Vec<Cameras>,
    /// Sensors by index of the vehicle, without the cameras.
    pub sensors: Vec<Sensors>,
    /// Light and weather.
    pub environment: Environment,
    /// Seed of the random positions in the weather: the same for all images.
    pub seed: u64,
    /// Moving objects, and the models of the vehicles.
    pub dynamic_objects: DynamicObjects,
    /// Instant that images show.
    pub predict: Predict,
    /// Name of the renderer and reason for it; another one may take over in flight.
    pub renderer: Mutex<RendererInfo>,
    /// Time to render all cameras of a tick.
    pub durations: StageDurations,
    /// Ticks rendered.
    pub ticks: AtomicU64,
    /// Ticks replaced by the next one before the encoder took them.
    pub ticks_skipped: AtomicU64,
}
