//! Benchmark of scene edits: one million splats of a room, of degree 3, compared with the time for reading and
//! writing them.
//!
//! `cargo bench -p vizflyt-splat --bench edit`; the target is a second for any step on two cores.

use std::hint::black_box;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use glam::{DQuat, Quat, Vec3};
use vizflyt_splat::Splats;
use vizflyt_splat::edit::{Carve, EditStep, Region};
use vizflyt_splat::format::{self, Format};

/// Number of splats of the scene.
const COUNT: usize = 1_000_000;

/// Returns a room of 8 x 6 x 3 m; a twentieth of its splats is haze and floaters, in and around it.
fn room() -> Splats {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    // xorshift64*, scaled to 0..1.
    let mut random = move || {
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40) as f32 / (1u32 << 24) as f32
    };
    let size = Vec3::new(8.0, 6.0, 3.0);
    let mut splats = Splats { sh_degree: 3, ..Splats::default() };
    for k in 0..COUNT {
        let mut p = Vec3::new(random(), random(), random()) * size;
        let is_haze = k % 20 == 0;
        if is_haze {
            p = (p - size / 2.0) * 3.0 + size / 2.0;
        } else {
            let face = k % 6;
            p[face / 2] = if face % 2 == 0 { 0.0 } else { size[face / 2] };
        }
        splats.means_m.push(p);
        splats.scales_m.push(Vec3::new(random(), random(), random()) * 0.03 + 1e-3);
        let q = Quat::from_xyzw(random(), random(), random(), random() + 1e-3);
        splats.rotations.push(q.normalize());
        splats.opacities.push(if is_haze { random() * 0.3 } else { random() });
        splats.sh.extend((0..48).map(|_| random() - 0.5));
    }
    splats
}

fn edits(criterion: &mut Criterion) {
    let splats = room();
    let mut group = criterion.benchmark_group("1 M splats, degree 3");
    group.sample_size(10);
    let bytes = format::encode(Format::Ply, &splats).expect("a file");
    group.bench_function("read (PLY)", |bencher| {
        bencher.iter(|| format::parse(black_box(&bytes), Format::Ply).expect("a scene"));
    });
    let lasso: Vec<[f64; 2]> = (0..200)
        .map(|k| {
            let (sin, cos) = (f64::from(k) * 0.031_415_9).sin_cos();
            [0.5 * cos, 0.4 * sin]
        })
        .collect();
    let lasso = Region::View {
        eye: [4.0, 3.0, 1.5],
        rotation: DQuat::from_rotation_x(1.2).to_array(),
        outline: lasso,
        visible: true,
    };
    let within = vec![Region::Box { min: [-0.1; 3], max: [8.1, 6.1, 2.0] }];
    let carve = Carve {
        path: vec![[1.0, 1.0, 1.0], [7.0, 5.0, 1.5]],
        radius: 0.2,
        depth: 0.3,
        cell: 0.05,
        reach: 8.0,
    };
    let turn = DQuat::from_rotation_x(0.7).to_array();
    for (name, step) in [
        ("crop to a box", EditStep::Crop { within }),
        ("remove in a lasso, in front", EditStep::Remove { within: vec![lasso] }),
        ("drop floaters", EditStep::Floaters { cell: 0.05, least: 50 }),
        ("keep the largest part", EditStep::Parts { cell: 0.05, keep: 1 }),
        ("carve", EditStep::Carve(carve)),
        ("decimate to half", EditStep::Decimate { count: COUNT as u32 / 2 }),
        ("turn", EditStep::Turn { rotation: turn }),
    ] {
        let once = |mut splats: Splats| {
            step.apply(&mut splats).expect("a step");
            splats
        };
        group.bench_function(name, |bencher| {
            bencher.iter_batched(|| splats.clone(), once, BatchSize::PerIteration);
        });
    }
    group.bench_function("write (PLY)", |bencher| {
        bencher.iter(|| format::encode(Format::Ply, black_box(&splats)).expect("a file"));
    });
    group.finish();
}

criterion_group!(benches, edits);
criterion_main!(benches);
