//! The twin as a picture, for pages whose browser cannot draw it itself, or too slowly.
//!
//! ```text
//! GET /api/twin?x_m=1&...&fov_deg=50&width_px=960&height_px=540&cut=true&background=0d1217
//!     a JPEG of the twin as that camera sees it ([`request`])
//! ```
//! What the page would draw is what is drawn: the splats of [`TwinParts`], 500,000 at most, without what moves. The
//! thread that draws is started by a request, gives way to all others ([`NICE`]), draws twice a second at most, and takes
//! a twentieth of one core; a minute after the last request it ends, and its memory with it.
//! Requests are answered in turn; of more than [`MAX_WAITING`] the newest is refused.

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

/// A JPEG, or why there is none.
pub(super) type Drawn = Result<Vec<u8>, String>;

/// Draws pictures of a twin, when asked.
#[derive(Debug)]
pub(crate) struct TwinPictures {
    twin: TwinParts,
    /// Least and greatest corner of the fence. [m, world]
    fence_m: [DVec3; 2],
    thread: Mutex<Option<(SyncSender<Asked>, JoinHandle<()>)>>,
}

/// A picture that somebody waits for.
#[derive(Debug)]
struct Asked {
    camera: Camera,
    cut: bool,
    answer: oneshot::Sender<Drawn>,
}

impl TwinPictures {
    /// Takes a twin, and the fence about the box from `min_m` to `max_m` [m, world].
    pub(crate) fn new(twin: TwinParts, min_m: DVec3, max_m: DVec3) -> Self {
        Self { twin, fence_m: [min_m, max_m], thread: Mutex::default() }
    }

    /// Asks for a picture: returns where it will come, or why it is refused.
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
        // A thread that ends at this very moment takes nothing either; the next request starts another one.
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

/// Draws what is asked for, until nobody has asked for [`KEPT`] or the server ends.
fn run(twin: &TwinParts, fence_m: [DVec3; 2], asked: &Receiver<Asked>) {
    // The renderer's passes run where it is called from: on this pool's one thread.
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
        // Its page has gone meanwhile.
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

/// Returns how long this thread has had a processor.
fn busy() -> Duration {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}

/// Returns when the next picture may be drawn, after one was from `began` to `ended` and took `busy` of a processor.
fn next_due(began: Instant, ended: Instant, busy: Duration) -> Instant {
    (began + EVERY).max(ended + REST * busy)
}

/// The lowest priority there is: 1.5 % of a core that others want, too.
const NICE: i32 = 19;
/// Twice a second.
const EVERY: Duration = Duration::from_millis(500);
/// So much longer it rests than it computes: it takes a twentieth of one core.
const REST: u32 = 19;
/// A page turns its camera within that, or somebody has gone for a coffee.
const KEPT: Duration = Duration::from_mins(1);
/// Each waits for half a second at least.
const MAX_WAITING: usize = 4;
const BUSY: &str = "too many pages ask for pictures of the twin; ask again in a second";
pub(super) const NO_THREAD: &str = "the twin cannot be drawn; the server's log says why";

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_splat::Splats;

    /// A red wall 3 m before the camera of [`camera`].
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

    /// Looks along z.
    pub(super) fn camera() -> Camera {
        Camera::new(Intrinsics::from_horizontal_fov(64, 48, 1.0), Pose::IDENTITY, 0.1)
    }

    fn pictures() -> TwinPictures {
        let (min_m, max_m) = (DVec3::splat(-5.0), DVec3::splat(5.0));
        TwinPictures::new(TwinParts::choose(&wall(), min_m, max_m), min_m, max_m)
    }

    #[test]
    fn twice_a_second_and_a_twentieth_of_a_core_at_most() {
        let began = Instant::now();
        let due_ms = |[took_ms, busy_ms]: [u64; 2]| {
            let [took, busy] = [took_ms, busy_ms].map(Duration::from_millis);
            (next_due(began, began + took, busy) - began).as_millis()
        };
        let alone = [[0; 2], [25; 2], [50; 2], [100; 2], [1000; 2]];
        assert_eq!(alone.map(due_ms), [500, 500, 1000, 2000, 20_000]);
        // What it waited for a processor is no work.
        assert_eq!([[1000, 0], [1000, 50]].map(due_ms), [1000, 1950]);
    }

    #[test]
    fn of_many_that_ask_at_once_the_last_are_refused() {
        let pictures = pictures();
        // A thread that never comes to its work.
        let (sender, asked) = sync_channel(MAX_WAITING);
        let (end, ends) = sync_channel::<()>(0);
        let stuck = std::thread::spawn(move || assert!(ends.recv().is_err()));
        *lock(&pictures.thread) = Some((sender, stuck));
        let waiting: Vec<_> = (0..10).map(|_| pictures.ask(camera(), false)).collect();
        assert_eq!(waiting.iter().filter(|asked| asked.is_ok()).count(), MAX_WAITING);
        assert!(waiting[MAX_WAITING..].iter().all(|asked| matches!(asked, Err(BUSY))));
        // Once it has ended, another one is started, and draws.
        drop((end, asked));
        let (_, stuck) = lock(&pictures.thread).take().unwrap();
        stuck.join().unwrap();
        let jpeg = pictures.ask(camera(), false).unwrap().blocking_recv().unwrap().unwrap();
        assert_eq!(jpeg[..2], [0xff, 0xd8]);
    }
}
