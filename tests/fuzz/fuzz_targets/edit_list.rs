//! Edit list: an error, or steps that are written as they were read and remove the stated number of splats.
#![no_main]
use glam::{Quat, Vec3};
use libfuzzer_sys::fuzz_target;
use vizflyt_server::scene::EditList;
use vizflyt_splat::Splats;
use vizflyt_splat::edit::{Carve, EditStep};

fuzz_target!(|text: &str| {
    let Ok(list) = EditList::parse(text) else { return };
    assert_eq!(EditList::parse(&list.to_toml()), Ok(list.clone()));
    let mut splats = scene();
    for done in list.steps.iter().take(8) {
        // A fine grid takes seconds, so it is skipped.
        let is_coarse = |carve: &Carve| {
            let all = carve.path.iter().flatten().chain([&carve.reach]);
            all.into_iter().all(|v| (v / carve.cell).abs() < 25.0)
        };
        if matches!(&done.edit, EditStep::Carve(carve) if !is_coarse(carve)) {
            continue;
        }
        let before = splats.clone();
        match done.edit.apply(&mut splats) {
            Ok(taken) => assert!(splats.len() + taken == before.len() && !splats.is_empty()),
            Err(_) => assert!(splats == before),
        }
    }
});

/// Returns a few splats of every kind.
fn scene() -> Splats {
    let count = 40;
    let even = |k: usize, root: f32| (k as f32 * root).fract();
    Splats {
        means_m: (0..count)
            .map(|k| Vec3::new(even(k, 0.8191), even(k, 0.671), even(k, 0.5497)) * 4.0 - 2.0)
            .collect(),
        scales_m: (0..count).map(|k| Vec3::new(0.02, 0.1, 0.4) * even(k, 0.31)).collect(),
        rotations: (0..count).map(|k| Quat::from_rotation_y(k as f32)).collect(),
        opacities: (0..count).map(|k| even(k, 0.77)).collect(),
        sh_degree: 1,
        sh: vec![0.2; count * 12],
        antialiased: false,
    }
}
