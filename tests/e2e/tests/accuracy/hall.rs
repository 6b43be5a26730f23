//! The lab's hall as a background of the tags: generated splats.

use std::sync::{Arc, Mutex};

use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};
use vizflyt_scenes::{SceneKind, generate};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage};
use vizflyt_tags::camera::TagCamera;
use vizflyt_tags::image::Gray;
use vizflyt_tags::simulated::{Background, Sensor, SimulatedCamera};

/// Returns the cameras in the hall, with exposures spread over the interval as for unsynchronised webcams.
pub(crate) fn seen_by(cameras: Vec<TagCamera>) -> Vec<SimulatedCamera> {
    let count = cameras.len() as f64;
    let before = before();
    let seen = cameras
        .into_iter()
        .enumerate()
        .map(|(i, camera)| before(camera, Sensor { phase: i as f64 / count, ..Sensor::default() }));
    seen.collect()
}

/// Returns a function that puts a camera into the hall.
pub(crate) fn before() -> impl Fn(TagCamera, Sensor) -> SimulatedCamera {
    let hall = Arc::new(Mutex::new(CpuRenderer::new(&generate(SceneKind::Room, 7).splats)));
    move |camera, sensor| {
        let behind = background(hall.clone(), camera.intrinsics);
        SimulatedCamera::before(camera, sensor, behind)
    }
}

/// Returns the background for a lens; it is rendered again only if the camera has moved.
fn background(hall: Arc<Mutex<CpuRenderer>>, intrinsics: Intrinsics) -> Background {
    let mut last: Option<(Pose<World, Cam>, Gray)> = None;
    Background::new(move |world_from_cam: &Pose<World, Cam>| {
        if let Some((at, image)) = &last
            && at == world_from_cam
        {
            return image.clone();
        }
        let camera = Camera::new(intrinsics, *world_from_cam, 0.05);
        let mut images = [RgbdImage::default()];
        hall.lock()
            .expect("no test panics here")
            .render(&[], &[camera], &mut images)
            .expect("rendered");
        let mut rgb = Vec::new();
        images[0].write_rgb8(&mut rgb);
        let grey =
            |c: &[u8]| (u32::from(c[0]) * 77 + u32::from(c[1]) * 150 + u32::from(c[2]) * 29) >> 8;
        let pixels = rgb.chunks_exact(3).map(|c| grey(c) as u8).collect();
        let image =
            Gray::new(images[0].width_px, images[0].height_px, pixels).expect("of this size");
        last = Some((*world_from_cam, image.clone()));
        image
    })
}
