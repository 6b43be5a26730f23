//! Insufficient buffers, small bindings, and lost devices.

use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_splat::gpu::{Budget, GpuRenderer};
use vizflyt_splat::{
    Backend, Camera, CpuRenderer, Detail, FallbackRenderer, NoRenderer, Rasterizer, RenderError,
    RgbdImage, RigidObject, Scene, choose,
};

use crate::agreement::assert_alike;
use crate::{adapter, renderer, twins};

fn render_all(renderer: &mut dyn Rasterizer, cameras: &[Camera]) -> Vec<RgbdImage> {
    let mut images = vec![RgbdImage::default(); cameras.len()];
    renderer.render(&[], cameras, &mut images).expect("images");
    images
}

fn with_budget<'a>(scene: impl Into<Scene<'a>>, budget: Budget) -> Option<GpuRenderer> {
    Some(GpuRenderer::new(scene, adapter()?, budget).expect("a device"))
}

#[test]
fn grows_buffers_that_are_too_small() {
    let splats = twins::cloud(3000, 0, 1);
    let cameras = [twins::camera(80, 60, 90.0), twins::camera(64, 64, 70.0)];
    let Some(mut ample) = renderer(&splats) else { return };
    let expected = render_all(&mut ample, &cameras);
    let work = ample.workload();
    assert!(work.pairs > 1000 && work.visible > 300, "{work:?}");
    for (regions, pairs) in [(1, 1 << 20), (4096, 1), (1, 1), (3, 1000)] {
        let budget = Budget { regions, pairs, ..Budget::default() };
        let mut gpu = with_budget(&splats, budget).expect("an adapter was there");
        // Two ticks in flight: both have too little room.
        let mut first = vec![RgbdImage::default(); 2];
        let mut second = first.clone();
        gpu.begin(&[], &cameras).expect("cameras");
        gpu.begin(&[], &cameras).expect("cameras");
        gpu.finish(&mut first).expect("images");
        gpu.finish(&mut second).expect("images");
        // Bit-identical: no splat is missing.
        assert!(first == expected && second == expected, "{regions} regions, {pairs} pairs");
        assert_eq!(gpu.workload(), work);
    }
}

#[test]
fn pixels_written_to_the_host_equal_copied_pixels() {
    let objects = [RigidObject { id: 9, splats: twins::ball(400, 0.4, 3) }];
    let splats = twins::cloud(2000, 1, 5);
    let at = [Some(vizflyt_protocol::geometry::Pose::new(
        glam::DVec3::new(0.1, 0.0, 1.5),
        glam::DQuat::IDENTITY,
    ))];
    // A small image after a large one reuses the memory of the large one.
    for objects in [&objects[..], &[]] {
        let scene = Scene { splats: &splats, objects };
        let Some(mut written) = with_budget(scene, Budget::default()) else { return };
        let copies = Budget { writes_to_host: false, ..Budget::default() };
        let mut copied = with_budget(scene, copies).expect("an adapter was there");
        for (width, height) in [(97, 61), (33, 20), (97, 60), (128, 70)] {
            let camera = [twins::camera(width, height, 80.0)];
            let mut images = [RgbdImage::default(), RgbdImage::default()];
            let at = &at[..objects.len()];
            written.render(at, &camera, &mut images[..1]).expect("an image");
            copied.render(at, &camera, &mut images[1..]).expect("an image");
            assert!(images[0] == images[1], "{width}x{height}, {} objects", objects.len());
            assert_eq!(images[0].ids.contains(&9), !objects.is_empty());
        }
    }
}

#[test]
fn splits_scenes_by_the_size_of_a_binding() {
    let splats = twins::cloud(1500, 3, 2);
    // 6 frame-filling blocks: harmonics for three, geometry for five, regions for six.
    let tiny = Budget { binding_bytes: 79_000, ..Budget::default() };
    let cameras: Vec<Camera> = (0..6u32).map(|i| twins::camera(20 + i, 30 - i, 80.0)).collect();
    let Some(mut ample) = renderer(&splats) else { return };
    let expected = render_all(&mut ample, &cameras);
    let mut gpu = with_budget(&splats, tiny).expect("an adapter was there");
    // Repeatedly more than fits at once.
    for _ in 0..2 {
        assert!(render_all(&mut gpu, &cameras) == expected);
    }
    assert!(render_all(&mut gpu, &cameras[..1])[0] == expected[0]);
    // Objects are in other chunks than the static part.
    let objects = [RigidObject { id: 9, splats: twins::ball(400, 0.4, 3) }];
    let small = twins::cloud(300, 1, 4);
    let scene = Scene { splats: &small, objects: &objects };
    let at = [Some(vizflyt_protocol::geometry::Pose::new(
        glam::DVec3::new(0.1, 0.0, 1.5),
        glam::DQuat::IDENTITY,
    ))];
    let mut images = [RgbdImage::default()];
    let mut expected = images.clone();
    let mut gpu = with_budget(scene, tiny).expect("an adapter was there");
    gpu.render(&at, &cameras[..1], &mut images).expect("an image");
    CpuRenderer::new(scene).render(&at, &cameras[..1], &mut expected).expect("an image");
    assert_alike("small bindings", &images[0], &expected[0]);
    assert!(images[0].ids.contains(&9));
}

#[test]
fn renders_images_too_large_for_the_device_on_the_cpu() {
    let splats = twins::cloud(1500, 0, 2);
    let tiny = Budget { binding_bytes: 79_000, ..Budget::default() };
    let Some(mut gpu) = with_budget(&splats, tiny) else { return };
    let large = [twins::camera(200, 100, 80.0)];
    let refused = gpu.render(&[], &large, &mut [RgbdImage::default()]);
    let Err(RenderError::Device(why)) = refused else { panic!("{refused:?}") };
    assert!(why.contains("pixels: 20000"), "{why}");
    // Smaller images still work.
    let small = [twins::camera(20, 20, 80.0)];
    let expected = render_all(&mut CpuRenderer::new(&splats), &small);
    assert_alike("after all", &render_all(&mut gpu, &small)[0], &expected[0]);
    let mut fallback = FallbackRenderer::new(Box::new(gpu), CpuRenderer::new(&splats));
    let expected = render_all(&mut CpuRenderer::new(&splats), &large);
    assert!(render_all(&mut fallback, &large) == expected);
    // Less than one block.
    let none = Budget { binding_bytes: 5000, ..Budget::default() };
    let refused = adapter().map(|adapter| GpuRenderer::new(&splats, adapter, none).map(|_| ()));
    assert!(matches!(refused, Some(Err(RenderError::Device(_)))), "{refused:?}");
}

#[test]
fn renders_the_widest_image_and_more_cameras_than_a_tick_has() {
    let splats = twins::cloud(300, 0, 2);
    let Some(mut gpu) = renderer(&splats) else { return };
    let mut cpu = CpuRenderer::new(&splats);
    let widest = [twins::camera(Intrinsics::MAX_SIDE_PX, 2, 80.0)];
    let expected = render_all(&mut cpu, &widest);
    assert_alike("the widest", &render_all(&mut gpu, &widest)[0], &expected[0]);
    // The maximum per tick is 4096.
    let mut many = vec![twins::camera(1, 1, 80.0); 4097];
    many[4096] = twins::camera(20, 10, 80.0);
    let expected = render_all(&mut cpu, &many[4096..]);
    assert_alike("the last", &render_all(&mut gpu, &many)[4096], &expected[0]);
}

#[test]
fn cpu_takes_over_when_a_device_is_lost() {
    let splats = twins::cloud(2000, 1, 6);
    let camera = [twins::camera(90, 70, 80.0)];
    let Some(mut gpu) = renderer(&splats) else { return };
    let before = render_all(&mut gpu, &camera);
    gpu.lose_device();
    let lost = gpu.render(&[], &camera, &mut [RgbdImage::default()]);
    assert!(matches!(lost, Err(RenderError::Device(_))), "{lost:?}");
    // The device stays lost.
    assert!(gpu.render(&[], &camera, &mut [RgbdImage::default()]).is_err());
    let mut fallback = FallbackRenderer::new(Box::new(gpu), CpuRenderer::new(&splats));
    assert!(fallback.name().starts_with("gpu "), "{}", fallback.name());
    let after = render_all(&mut fallback, &camera);
    assert_alike("before and after", &after[0], &before[0]);
    let name = fallback.name();
    assert!(name.starts_with("cpu ") && name.contains("is lost"), "{name}");
}

#[test]
fn device_lost_between_begin_and_finish_is_an_error() {
    let splats = twins::cloud(2000, 0, 6);
    let camera = [twins::camera(90, 70, 80.0)];
    let Some(mut gpu) = renderer(&splats) else { return };
    gpu.begin(&[], &camera).expect("a camera");
    gpu.lose_device();
    // Either the tick was finished before, or the loss is reported; nothing hangs or panics.
    let mut image = [RgbdImage::default()];
    match gpu.finish(&mut image) {
        Ok(_) => crate::compare::assert_clean(&image[0]),
        Err(error) => assert!(matches!(error, RenderError::Device(_)), "{error}"),
    }
    assert!(gpu.begin(&[], &camera).and_then(|()| gpu.finish(&mut image).map(|_| ())).is_err());
}

#[test]
fn choice_of_the_renderer_has_a_reason() {
    let splats = twins::cloud(1500, 0, 8);
    let camera = [twins::camera(60, 40, 80.0)];
    let expected = render_all(&mut CpuRenderer::new(&splats), &camera);
    let check = |backend: Backend| {
        let mut chosen = choose(&splats, backend, Detail::Full).expect("a renderer");
        println!("{backend:?}: {} because {}", chosen.rasterizer.name(), chosen.reason);
        let image = render_all(&mut *chosen.rasterizer, &camera);
        assert_alike(&format!("{backend:?}"), &image[0], &expected[0]);
        (chosen.rasterizer.name().into_owned(), chosen.reason)
    };
    let (name, reason) = check(Backend::Cpu);
    assert!(name.starts_with("cpu ") && reason.starts_with("asked for"), "{name}: {reason}");
    let (name, reason) = check(Backend::Auto);
    match adapter() {
        None => {
            assert!(name.starts_with("cpu ") && reason.contains("no graphics adapter"), "{reason}");
            let refused = choose(&splats, Backend::Gpu, Detail::Full).map(|chosen| chosen.reason);
            assert!(matches!(refused, Err(NoRenderer::Gpu(_))), "{refused:?}");
        }
        Some(adapter) => {
            assert!(reason.contains(&adapter.name().name), "{reason}");
            assert_eq!(name.starts_with("cpu "), adapter.name().is_software, "{name}: {reason}");
            let (name, reason) = check(Backend::Gpu);
            assert!(name.starts_with("gpu ") && reason.contains(" dB"), "{name}: {reason}");
        }
    }
}
