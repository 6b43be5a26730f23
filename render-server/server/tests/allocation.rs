//! The render thread allocates nothing once every buffer has been used: two vehicles, four cameras; some ticks are
//! encoded, some skipped, all passed on to the previews.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Duration;

use glam::{DQuat, DVec3};
use vizflyt_arena::{ArenaConfig, MovingObjects};
use vizflyt_fixtures::CountingAllocator;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::messages::PoseSample;
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::poses::Localization;
use vizflyt_server::poses::newest::Localized;
use vizflyt_server::render::Rendering;
use vizflyt_server::render::cameras::Cameras;
use vizflyt_server::render::dynamic_objects::DynamicObjects;
use vizflyt_server::render::inputs::Inputs;
use vizflyt_server::render::rendered::RenderQueue;
use vizflyt_server::stop::Stop;
use vizflyt_server::stream::Rooms;
use vizflyt_server::stream::rate_control::Adaptation;
use vizflyt_splat::{Camera, PassTimes, Placement, Rasterizer, RenderError, RgbdImage, Workload};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

const ARENA: &str = r#"
name = "two"
scene = "scene.ply"
body_radius_m = 0.12
takeoff_height_m = 1.2
spawn = { position_m = [0, 0, 0] }
geofence = { min_m = [-5, -5, -0.5], max_m = [5, 5, 4] }
limits = { max_speed_mps = 6.0, max_acceleration_mps2 = 8.0 }
[[objects]]
name = "door"
scene = "door.ply"
position_m = [1, 0, 0]
motion = { kind = "oscillation", slide_m = [0, 1, 0], period_s = 3.0 }
[[cameras]]
name = "front"
width_px = 64
height_px = 48
horizontal_fov_deg = 90.0
position_m = [0, 0, 0]
[[cameras]]
name = "rear"
width_px = 32
height_px = 24
horizontal_fov_deg = 90.0
position_m = [0, 0, 0]
rate_hz = 300.0
imaging = { sensor = "imx219", denoise = true, depth = { model = "azure-kinect" } }
"#;

/// Renderer that only fills images of the right size. Between two ticks, it also does the work of the other threads:
/// publishes the next poses, encodes some ticks, and makes previews.
struct Everyone {
    stop: Stop,
    localization: Arc<Localization>,
    ticks: Arc<RenderQueue>,
    calls: u64,
    images: usize,
    /// Allocations of this thread up to the end of the warm-up.
    warm: usize,
}

impl Everyone {
    /// Publishes the next poses; sometimes one vehicle has none.
    fn move_on(localization: &Localization, at: u64) {
        let stamp = ServerTime::from_ns(at);
        let still = Pose::new(DVec3::Z, DQuat::IDENTITY);
        let sample = Localized::still(PoseSample::still(stamp, still));
        localization.vehicles[0].newest.send_replace(Some(sample));
        if !at.is_multiple_of(7) {
            localization.vehicles[1].newest.send_replace(Some(sample));
        }
        localization.accepted.put(());
    }
}

impl Rasterizer for Everyone {
    fn name(&self) -> Cow<'_, str> {
        "nothing".into()
    }

    fn render(
        &mut self,
        placements: &[Placement],
        cameras: &[Camera],
        images: &mut [RgbdImage],
    ) -> Result<PassTimes, RenderError> {
        for (camera, image) in cameras.iter().zip(images) {
            image.resize(camera.intrinsics.width_px, camera.intrinsics.height_px);
            image.rgb.fill(RENDERED);
            image.alpha.fill(1.0);
            image.depth_median_m.fill(2.0);
        }
        // The door, and the other vehicle, if it has a pose.
        assert!(placements.len() == 3 && placements[0].is_some());
        assert!(placements[1..].contains(&None));
        self.calls += 1;
        self.images += cameras.len();
        match self.calls {
            WARM_UP => self.warm = CountingAllocator::thread_allocations(),
            TICKS => self.stop.set(),
            _ => {}
        }
        if self.calls.is_multiple_of(3)
            && let Some(tick) = self.ticks.take(Duration::ZERO)
        {
            for slot in tick.slots.iter().filter(|slot| slot.fresh) {
                // The front camera is ideal, the rear one is not.
                let is_perfect = slot.image.rgb.iter().all(|&value| value == RENDERED);
                let is_depth = slot.image.depth_median_m.iter().all(|&depth_m| depth_m == 2.0);
                assert_eq!([is_perfect, is_depth], [slot.camera == 0; 2]);
            }
            self.ticks.offer_previews(tick);
        }
        if self.calls.is_multiple_of(2) {
            drop(self.ticks.take_for_previews(Duration::ZERO));
        }
        Self::move_on(&self.localization, self.calls);
        Ok(PassTimes::default())
    }

    fn workload(&self) -> Workload {
        Workload::default()
    }
}

/// Display colour of every pixel.
const RENDERED: f32 = 0.3;
/// Each camera's due time, and therefore the buffers that it gets, depends on the machine's clock. After this many
/// ticks, each buffer has been with each camera.
const WARM_UP: u64 = 600;
const TICKS: u64 = 900;

#[test]
fn rendering_allocates_nothing_after_warm_up() {
    let arena = ArenaConfig::parse(ARENA).unwrap();
    let vehicle = |name| (name, arena.info(), arena.cameras.clone());
    let vehicles = vec![vehicle("wasp"), vehicle("bee")];
    let rooms = Rooms::bare(vehicles, Adaptation::default(), Stop::default());
    let objects = MovingObjects::new(&arena, 0);
    let rendering = Rendering {
        cameras: [(); 2].map(|()| Cameras::new(arena.cameras.clone())).into(),
        dynamic_objects: DynamicObjects::new(ServerTime::ZERO, objects, &[], 2),
        ..Rendering::default()
    };
    rooms.streaming.subscriptions.viewer_came(0);
    rooms.streaming.subscriptions.viewer_came(1);
    vizflyt_process::lock(&rendering.renderer).name = "nothing".to_owned();
    let ticks = Arc::new(RenderQueue::default());
    Everyone::move_on(&rooms.localization, 1);
    let mut everyone = Everyone {
        stop: rooms.stop.clone(),
        localization: rooms.localization.clone(),
        ticks: ticks.clone(),
        calls: 0,
        images: 0,
        warm: 0,
    };
    let inputs = Inputs { rendering: &rendering, ..rooms.render_inputs() };
    // On a thread of the pool: rayon occasionally allocates to accept work from outside.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool");
    let allocated = pool.install(|| {
        let (renderer, max_rate_hz) = (&mut everyone, 1000.0);
        let stop = &rooms.stop;
        vizflyt_server::render::thread::run(inputs, renderer, &ticks, max_rate_hz, stop);
        CountingAllocator::thread_allocations()
    }) - everyone.warm;
    assert!(everyone.warm > 0 && everyone.images as u64 > TICKS, "{}", everyone.images);
    // Leaving the function frees memory, which is not counted.
    assert_eq!(allocated, 0, "in {} ticks", TICKS - WARM_UP);
}
