//! Images of the twin, for pages whose browser cannot render it, or only too slowly.
//!
//! ```text
//! GET /api/twin?x_m=1&...&fov_deg=50&width_px=960&height_px=540&cut=true&background=0d1217
//!    a JPEG of the twin from this camera ([`request`])
//! ```
//! The image contains the same splats as the page's 3D view: those of [`TwinParts`], at most 500,000, without moving
//! objects. The rendering thread starts on request, at the lowest priority ([`NICE`]). It renders at most twice per
//! second, and uses at most a twentieth of one core. It ends one minute after the last request, and frees its memory.
//! Requests are answered in order; if [`MAX_WAITING`] wait, new ones are rejected.

mod engine;
mod request;

use std::sync::Mutex;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use glam::DVec3;
use nix::time::{ClockId, clock_gettime};
use tokio::sync::oneshot;
use tracing::warn;
use vizflyt_splat::Camera;

use self::engine::Engine;
pub(super) use self::request::PictureRequest;
use super::twin::TwinParts;
use crate::priority::give_way;
use vizflyt_process::lock;

/// A JPEG, or the reason of a failure.
pub(super) type Drawn = Result<Vec<u8>, String>;

/// Renders images of a twin on request.
#[derive(Debug)]
pub(crate) struct TwinPictures {
    twin: TwinParts,
    /// Minimum and maximum corner of the fence. [m, world]
    fence_m: [DVec3; 2],
    thread: Mutex<Option<(SyncSender<Asked>, JoinHandle<()>)>>,
}

/// A requested image.
#[derive(Debug)]
struct Asked {
    camera: Camera,
    cut: bool,
    answer: oneshot::Sender<Drawn>,
}

impl TwinPictures {
    /// Uses a twin, and the fence box from `min_m` to `max_m` [m, world].
    pub(crate) fn new(twin: TwinParts, min_m: DVec3, max_m: DVec3) -> Self {
        Self { twin, fence_m: [min_m, max_m], thread: Mutex::default() }
    }

    /// Requests an image: returns a receiver of the result, or the reason of a rejection.
    pub(super) fn ask(
        &self,
        camera: Camera,
        cut: bool,
    ) -> Result<oneshot::Receiver<Drawn>, &'static str> {
        let mut thread = lock(&self.thread);
        if thread.as_ref().is_none_or(|(_, handle)| handle.is_finished()) {
            *thread = Some(self.start().map_err(|error| {
                warn!("page: the twin cannot be drawn: {error}");
                NO_THREAD
            })?);
        }
        let (answer, drawn) = oneshot::channel();
        // A thread that is just ending rejects the request as well; the next request starts another one.
        let asked = Asked { camera, cut, answer };
        let is_sent = thread.as_ref().is_some_and(|(sender, _)| sender.try_send(asked).is_ok());
        if is_sent { Ok(drawn) } else { Err(BUSY) }
    }

    fn start(&self) -> std::io::Result<(SyncSender<Asked>, JoinHandle<()>)> {
        let (sender, asked) = sync_channel(MAX_WAITING);
        let (twin, fence_m) = (self.twin.clone(), self.fence_m);
        let thread = std::thread::Builder::new().name("twin".to_owned());
        Ok((sender, thread.spawn(move || run(&twin, fence_m, &asked))?))
    }
}

/// Renders requests until none has arrived for [`KEPT`], or the server stops.
fn run(twin: &TwinParts, fence_m: [DVec3; 2], asked: &Receiver<Asked>) {
    // The renderer's passes run on this pool's only thread.
    let pool =
        rayon::ThreadPoolBuilder::new().num_threads(1).start_handler(|_| give_way(NICE)).build();
    let pool = match pool {
        Ok(pool) => pool,
        Err(error) => return warn!("page: the twin cannot be drawn: {error}"),
    };
    let engine = pool.install(|| Engine::new(twin, fence_m));
    let mut engine = match engine {
        Ok(engine) => engine,
        Err(error) => return warn!("page: the twin cannot be drawn: {error}"),
    };
    let mut due = Instant::now();
    while let Ok(next) = asked.recv_timeout(KEPT) {
        sleep(due.saturating_duration_since(Instant::now()));
        // The page has closed its connection.
        if next.answer.is_closed() {
            continue;
        }
        let began = Instant::now();
        let (drawn, busy) = pool.install(|| {
            let before = busy();
            (engine.draw(&next.camera, next.cut), busy().saturating_sub(before))
        });
        due = next_due(began, Instant::now(), busy);
        let _ = next.answer.send(drawn);
    }
}

/// Returns the processor time of this thread.
fn busy() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}

/// Returns the earliest time of the next image, after one from `began` to `ended` that used `busy` of processor time.
fn next_due(began: Instant, ended: Instant, busy: Duration) -> Instant {
    (began + EVERY).max(ended + REST * busy)
}

/// Lowest priority: uses 1.5 % of a core that other threads need.
const NICE: i32 = 19;
/// Minimum interval of images.
const EVERY: Duration = Duration::from_millis(500);
/// Ratio of pause to computation: the thread uses a twentieth of one core.
const REST: u32 = 19;
/// Idle time after which the thread ends; an active page turns its camera more often.
const KEPT: Duration = Duration::from_mins(1);
/// Maximum number of waiting requests; each takes at least half a second.
const MAX_WAITING: usize = 4;
const BUSY: &str = "too many requests for images of the twin; retry in a second";
pub(super) const NO_THREAD: &str = "the twin cannot be rendered; see the server's log";

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_splat::Splats;

    /// A red wall 3 m in front of [`camera`].
    pub(super) fn wall() -> Splats {
        let means = (-20..=20).flat_map(|x| (-20..=20).map(move |y| (x, y)));
        let means_m: Vec<_> =
            means.map(|(x, y)| Vec3::new(x as f32 * 0.2, y as f32 * 0.2, 3.0)).collect();
        let count = means_m.len();
        Splats {
            means_m,
            scales_m: vec![Vec3::new(0.2, 0.2, 0.01); count],
            rotations: vec![Quat::IDENTITY; count],
            opacities: vec![0.99; count],
            sh_degree: 0,
            sh: [1.5, -1.5, -1.5].repeat(count),
            antialiased: false,
        }
    }

    /// Returns a camera that looks along z.
    pub(super) fn camera() -> Camera {
        Camera::new(Intrinsics::from_horizontal_fov(64, 48, 1.0), Pose::IDENTITY, 0.1)
    }

    fn pictures() -> TwinPictures {
        let (min_m, max_m) = (DVec3::splat(-5.0), DVec3::splat(5.0));
        TwinPictures::new(TwinParts::choose(&wall(), min_m, max_m), min_m, max_m)
    }

    #[test]
    fn renders_at_most_twice_a_second_on_a_twentieth_of_a_core() {
        let began = Instant::now();
        let due_ms = |[took_ms, busy_ms]: [u64; 2]| {
            let [took, busy] = [took_ms, busy_ms].map(Duration::from_millis);
            (next_due(began, began + took, busy) - began).as_millis()
        };
        let alone = [[0; 2], [25; 2], [50; 2], [100; 2], [1000; 2]];
        assert_eq!(alone.map(due_ms), [500, 500, 1000, 2000, 20_000]);
        // Time spent waiting for a processor does not count.
        assert_eq!([[1000, 0], [1000, 50]].map(due_ms), [1000, 1950]);
    }

    #[test]
    fn rejects_requests_above_the_maximum() {
        let pictures = pictures();
        // A thread that never processes its requests.
        let (sender, asked) = sync_channel(MAX_WAITING);
        let (end, ends) = sync_channel::<()>(0);
        let stuck = std::thread::spawn(move || assert!(ends.recv().is_err()));
        *lock(&pictures.thread) = Some((sender, stuck));
        let waiting: Vec<_> = (0..10).map(|_| pictures.ask(camera(), false)).collect();
        assert_eq!(waiting.iter().filter(|asked| asked.is_ok()).count(), MAX_WAITING);
        assert!(waiting[MAX_WAITING..].iter().all(|asked| matches!(asked, Err(BUSY))));
        // After it has ended, another one starts, and renders.
        drop((end, asked));
        let (_, stuck) = lock(&pictures.thread).take().unwrap();
        stuck.join().unwrap();
        let jpeg = pictures.ask(camera(), false).unwrap().blocking_recv().unwrap().unwrap();
        assert_eq!(jpeg[..2], [0xff, 0xd8]);
    }
}
