//! Checks that the runtime allocates nothing per image from the mailbox to the plugin's shared memory, after
//! its buffers have reached their size. Colour is lossless here, because the JPEG libraries allocate a few
//! small buffers per image.

use std::sync::Arc;
use std::time::Duration;

use vizflyt_fixtures::CountingAllocator;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_protocol::messages::{CameraInfo, bounded};
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_rgbd::{ColorMode, EncodeOptions, Encoder, RgbdView, peek, slice_len};
use vizflyt_runtime::images::ImagePublisher;
use vizflyt_runtime::stream::{Arrival, Mailbox, Whole};
use vizflyt_sdk::ipc::{PluginEnd, RuntimeEnd};
use vizflyt_sdk::{Observation, ObservationWriter, host_now};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

const SIZE: (u32, u32) = (64, 48);

/// Returns an image's bitstream, split into pieces as by the receiver.
fn pieces() -> Vec<Vec<u8>> {
    let (width, height) = SIZE;
    let pixels = (width * height) as usize;
    let rgb: Vec<u8> = (0..3 * pixels).map(|n| (n * 7 % 251) as u8).collect();
    let depth_mm: Vec<u16> = (0..pixels).map(|n| 2000 + (n % 300) as u16).collect();
    let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
    let mut bytes = Vec::new();
    let options = EncodeOptions { color_mode: ColorMode::Lossless, ..EncodeOptions::default() };
    Encoder::new(options).encode(&view, &mut bytes).unwrap();
    let header_len = peek(&bytes).unwrap().header_len;
    let (head, mut rest) = bytes.split_at(header_len);
    let mut pieces = vec![head.to_vec()];
    while !rest.is_empty() {
        let (slice, after) = rest.split_at(slice_len(rest).unwrap() as usize);
        pieces.push(slice.to_vec());
        rest = after;
    }
    pieces
}

#[test]
fn allocates_nothing_per_image_in_the_steady_state() {
    let (width, height) = SIZE;
    let camera = CameraInfo::forward("front", Intrinsics::from_horizontal_fov(width, height, 1.5));
    let cameras = vec![camera.clone()];
    let runtime = RuntimeEnd::new(ObservationWriter::len_for(&cameras));
    let plugin = PluginEnd::attach(runtime.connect().unwrap()).unwrap();
    let mut publisher = ImagePublisher::new(Arc::new(runtime), cameras, Arc::default());
    let mailbox = Mailbox::default();
    let (pieces, session) = (pieces(), mailbox.session());
    let len = pieces.iter().map(Vec::len).sum::<usize>() as u32;
    // The receiver's buffer; the mailbox replaces it by an empty one.
    let mut piece = Vec::new();
    let mut publish = |seq: u64| {
        let stamp = ServerTime::from_ns(seq * 10_000_000);
        let (k, mount) = (&camera.intrinsics, &camera.body_from_cam);
        let mut header = ImageHeader::new(seq, 0, stamp, k, mount, &Pose::IDENTITY);
        header.together = 1.into();
        let pose = HostTime::from_ns(stamp.as_ns());
        let arrival = Arrival { session, header, pose, first: host_now() };
        let ticket = mailbox.open(&arrival).unwrap();
        for bytes in &pieces {
            piece.clear();
            piece.extend_from_slice(bytes);
            assert!(mailbox.push(ticket, &mut piece));
        }
        let trailer = ImageTrailer::new(len, stamp, stamp);
        mailbox.end(ticket, Some(Whole { trailer, received: host_now() }));
        let mut published = 0;
        let mut notify = |_| published += 1;
        while publisher.step(&mailbox, Duration::ZERO, &mut notify).unwrap() {}
        published
    };
    let names = [bounded("front")];
    let mut count = 0;
    for seq in 1..=60 {
        let before = CountingAllocator::thread_allocations();
        let published = publish(seq);
        let allocations = CountingAllocator::thread_allocations() - before;
        assert_eq!(published, 1, "image {seq}");
        let sample = plugin.observation().unwrap().expect("the plugin sees it");
        let seen = Observation::from_bytes(sample.bytes(), &names).unwrap();
        assert_eq!(seen.camera("front").unwrap().seq, seq);
        // After some images, all reused buffers have reached their size.
        if seq > 20 {
            count += allocations;
        }
    }
    assert_eq!(count, 0, "allocations in 40 images");
}
