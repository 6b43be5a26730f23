//! Start of the threads: pose, render, encode, previews, and sensors if there are any.

use std::sync::Arc;
use std::thread::JoinHandle;

use anyhow::{Context, Result};
use vizflyt_arena::Referee;
use vizflyt_splat::Rasterizer;
use vizflyt_splat::sensor::SensorScene;

use crate::args::ServeArgs;
use crate::poses::drivers::PoseSource;
use crate::poses::thread::PoseThread;
use crate::priority::give_way;
use crate::render::rendered::RenderQueue;
use crate::stream::Rooms;
use crate::web::previews::{self, Previews};
use crate::{render, stream};

/// Shared inputs of the threads.
pub(super) struct Threads<'a> {
    pub(super) rooms: &'a Rooms,
    pub(super) previews: &'a Arc<Previews>,
    /// Whether the vehicles see and collide with each other.
    pub(super) neighbours: bool,
}

impl Threads<'_> {
    /// Starts the threads; they end when the server stops.
    pub(super) fn start(
        &self,
        args: &ServeArgs,
        mut renderer: Box<dyn Rasterizer>,
        referees: Vec<Referee>,
        mut source: Box<dyn PoseSource>,
        sensor_scene: Option<SensorScene>,
    ) -> Result<Vec<JoinHandle<()>>> {
        let ticks = Arc::new(RenderQueue::default());
        let pose_thread = PoseThread {
            localization: self.rooms.localization.clone(),
            flights: self.rooms.flights.clone(),
            referees,
            neighbours: self.neighbours,
        };
        let stop = self.rooms.stop.clone();
        let pose = move || pose_thread.run(&mut *source, &stop);
        let (rooms, published, max_rate_hz) = (self.rooms.clone(), ticks.clone(), args.max_rate);
        let render = move || {
            let (inputs, stop) = (rooms.render_inputs(), &rooms.stop);
            render::thread::run(inputs, &mut *renderer, &published, max_rate_hz, stop);
        };
        let (rooms, rendered, options) = (self.rooms.clone(), ticks.clone(), args.encode_options());
        let encode = move || {
            let Rooms { streaming, flights, stop, .. } = &rooms;
            stream::encode::run(streaming, flights, &rendered, options, stop);
        };
        let (rooms, made) = (self.rooms.clone(), self.previews.clone());
        let previews = move || {
            give_way(PREVIEWS_NICE);
            let Rooms { streaming, flights, stop, .. } = &rooms;
            previews::run(&made, flights, &streaming.subscriptions, &ticks, stop);
        };
        let mut threads = vec![
            start("pose", pose)?,
            start("render", render)?,
            start("encode", encode)?,
            start("previews", previews)?,
        ];
        if let Some(scene) = sensor_scene {
            let rooms = self.rooms.clone();
            let sensors = move || {
                render::sensors::thread::run(rooms.render_inputs(), &scene, &rooms.stop);
            };
            threads.push(start("sensors", sensors)?);
        }
        Ok(threads)
    }
}

fn start(name: &str, run: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>> {
    let thread = std::thread::Builder::new().name(name.to_owned());
    thread.spawn(run).with_context(|| format!("cannot start the {name} thread"))
}

/// Niceness of the previews: they take a tenth of a core from the threads of a flight, and otherwise use idle
/// time.
const PREVIEWS_NICE: i32 = 10;
