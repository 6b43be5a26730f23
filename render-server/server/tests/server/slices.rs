//! Between renderer and transport, an image causes no allocations in this project's code once the buffers have their
//! size: quantized, encoded, passed to two subscribers, acknowledged. (Colour is exact here, because the JPEG libraries
//! allocate a few small buffers per image.)

use std::pin::pin;
use std::task::{Context, Poll, Waker};

use glam::DVec3;
use vizflyt_arena::config::CameraConfig;
use vizflyt_fixtures::CountingAllocator;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::messages::Purpose;
use vizflyt_rgbd::{ColorMode, EncodeOptions};
use vizflyt_server::render::cameras::Cameras;
use vizflyt_server::render::rendered::RenderedImage;
use vizflyt_server::stream::encode::slices::SliceEncoder;
use vizflyt_server::stream::subscriptions::{Part, Slots, Subscriptions};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Returns the result of a future that is ready.
fn now<T>(future: impl Future<Output = T>) -> T {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => value,
        Poll::Pending => panic!("nothing has come"),
    }
}

/// Takes an image as the transport would, and releases it; returns the size of its bitstream.
fn take(subscriptions: &Subscriptions, id: u64, places: &Slots) -> usize {
    let image = &places[0][0];
    now(image.image());
    let mut len = 0;
    loop {
        match now(image.part()) {
            Part::Bytes(bytes) => len += bytes.len(),
            Part::End { .. } => break,
            Part::Cut => panic!("cut off"),
        }
    }
    subscriptions.landed(0, 0, id, 0, image);
    len
}

#[test]
fn an_image_allocates_nothing_after_warm_up() {
    let camera = "name = 'front'\nwidth_px = 320\nheight_px = 240\nhorizontal_fov_deg = 90.0\n\
                  position_m = [0, 0, 0]";
    let camera: CameraConfig = toml::from_str(camera).unwrap();
    let mut slot = RenderedImage {
        fresh: true,
        world_from_body: Some(Pose::new(DVec3::Z, glam::DQuat::IDENTITY)),
        set: Some(Cameras::new(vec![camera]).newest()),
        ..RenderedImage::default()
    };
    slot.image.resize(320, 240);
    slot.image.alpha.fill(1.0);
    let subscriptions = Subscriptions::new(&[1]);
    let runtime = subscriptions.open(0, 1, Purpose::Fly, 2);
    let watcher = subscriptions.open(0, 2, Purpose::Watch, 2);
    let options = EncodeOptions { color_mode: ColorMode::Lossless, ..EncodeOptions::default() };
    let mut encoder = SliceEncoder::new(options);
    let mut turn = |round: usize| {
        for (n, value) in slot.image.rgb.iter_mut().enumerate() {
            *value = ((n * 31 + round) % 200) as f32 / 255.0;
        }
        for (n, depth_m) in slot.image.depth_median_m.iter_mut().enumerate() {
            *depth_m = ((n * 7919 + round) % 9000) as f32 / 1000.0;
        }
        slot.seq += 1;
        let before = CountingAllocator::thread_allocations();
        assert!(encoder.send(&subscriptions, &slot, 1).unwrap().is_some());
        let sent = [take(&subscriptions, 1, &runtime), take(&subscriptions, 2, &watcher)];
        let allocations = CountingAllocator::thread_allocations() - before;
        assert!(sent[0] > 50_000 && sent[0] == sent[1], "{sent:?}");
        allocations
    };
    assert!((0..4).map(&mut turn).sum::<usize>() > 0, "the counter counts");
    for round in 4..20 {
        assert_eq!(turn(round), 0, "image {round}");
    }
}
