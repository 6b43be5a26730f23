//! A device must render the host's rows, although it receives only the changed ones.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::gpu::{Adapter, Budget};

use super::*;
use crate::loss::Target;
use crate::render::{Renderer, tests};
use crate::view::View;

/// Returns six photos of some Gaussians.
fn dataset() -> Dataset {
    let k = Intrinsics::from_horizontal_fov(64, 48, 1.2);
    let view = |x: f64| {
        let pose = Pose::new(DVec3::new(x, 0.0, 0.0), DQuat::from_rotation_y(-0.2 * x));
        View::new(&k, &pose, 0.05)
    };
    let scene = tests::scene(300, 1, &view(0.0), 6);
    let style = Style { degree: 1, antialiased: false };
    let photo = |x: f64| {
        let view = view(x);
        let mut renderer = Renderer::default();
        let image = renderer.forward(&scene, &view, style);
        let pixels = (0..48).flat_map(|y| (0..64).map(move |x| (x, y)));
        let level = |v: f32| (v.clamp(0.0, 1.0) * 255.0) as u8;
        let rgb = pixels.flat_map(|(x, y)| [0, 1, 2].map(|c| level(image.at(c, x, y)))).collect();
        let target = Target { width: 64, height: 48, rgb, ..Target::default() };
        Photo { name: String::new(), view, target }
    };
    Dataset { photos: [-0.5, -0.3, -0.1, 0.1, 0.3, 0.5].map(photo).into(), ..Dataset::default() }
}

#[test]
fn uploading_only_changed_rows_trains_the_same_twin() {
    let Some(adapter) = Adapter::all().into_iter().next() else {
        println!("skipped: no graphics adapter; install mesa-vulkan-drivers and libvulkan1");
        return;
    };
    let dataset = dataset();
    let options = Options { steps: 60, splats: 900, hold_out: 3, ..Options::default() };
    let train = |all: bool| {
        let passes = Passes::gpu(&adapter, Budget::default()).expect("a device");
        let mut trainer = Trainer::with(&dataset, options, passes);
        let mut judged = Vec::new();
        while trainer.steps() < options.steps {
            if all {
                trainer.stale = None;
            }
            trainer.step();
            // Images of other photos in between, also directly after a relocation.
            if trainer.steps().is_multiple_of(25) {
                judged.push(trainer.judge().map(|quality| quality.psnr_db.to_bits()));
            }
        }
        assert!(trainer.passes().take_lost().is_none());
        let Times { forward, device, .. } = trainer.times();
        let device = device.expect("it trained on a device");
        assert!(forward > 0.0 && device.rows > 0.0 && device.rows < forward);
        let numbers = trainer.gaussians().values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        (judged, numbers)
    };
    let (changed, all) = (train(false), train(true));
    assert!(changed.0 == all.0, "{:?} judged for {:?}", changed.0, all.0);
    assert!(changed.1 == all.1, "another twin");
}
