//! Benchmark of loading scenes of every format: one million splats, from bytes in memory to [`Splats`].
//!
//! `cargo bench -p vizflyt-splat --bench formats`; the target is a second each on two cores.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use glam::{Quat, Vec3};
use vizflyt_splat::Splats;
use vizflyt_splat::format::{self, Format};

/// Number of splats per scene.
const COUNT: usize = 1_000_000;

/// Returns splats similar to those of a capture: clustered positions, log-normal sizes, harmonics that fade with
/// their degree.
fn scene(count: usize, sh_degree: u8) -> Splats {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    // xorshift64*, scaled to -1..1.
    let mut random = move || {
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40) as f32 / (1u32 << 23) as f32 - 1.0
    };
    let mut splats = Splats { sh_degree, ..Splats::default() };
    let coefficients = splats.sh_coefficients();
    let mut centre = Vec3::ZERO;
    for i in 0..count {
        if i % 500 == 0 {
            centre = Vec3::new(random(), random(), random()) * 10.0;
        }
        let (a, b, c) = (random(), random(), random());
        splats.means_m.push(centre + Vec3::new(a * b, b * c, c * a));
        splats
            .scales_m
            .push(Vec3::new(random(), random(), random() - 1.0).map(|v| (v - 4.0).exp()));
        let q = Quat::from_xyzw(random(), random(), random(), random() + 1e-3);
        splats.rotations.push(q.normalize());
        splats.opacities.push(random() * 0.5 + 0.5);
        for k in 0..coefficients {
            let size = if k == 0 { 1.5 } else { 0.2 / (k as f32).sqrt() };
            splats.sh.extend([random() * size, random() * size, random() * size]);
        }
    }
    splats
}

fn formats(criterion: &mut Criterion) {
    for sh_degree in [0, 3] {
        let splats = scene(COUNT, sh_degree);
        let mut group = criterion.benchmark_group(format!("load 1 M, degree {sh_degree}"));
        group.sample_size(10).throughput(Throughput::Elements(COUNT as u64));
        for format in Format::ALL {
            if sh_degree > format.max_sh_degree() {
                continue;
            }
            let bytes = format::encode(format, &splats).expect("a file");
            let name = format!("{format} ({} MB)", bytes.len() / 1_000_000);
            group.bench_function(BenchmarkId::from_parameter(name), |bencher| {
                bencher.iter(|| format::parse(black_box(&bytes), format).expect("a scene"));
            });
        }
        group.finish();
    }
}

criterion_group!(benches, formats);
criterion_main!(benches);
