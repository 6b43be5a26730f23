//! Loading a scene takes at most twice the memory of the loaded scene. (The file is mapped, and its pages can be
//! dropped by the system.) In a separate binary, because it counts allocations.

use glam::{Quat, Vec3};
use vizflyt_fixtures::CountingAllocator;
use vizflyt_splat::Splats;
use vizflyt_splat::format::{self, Format};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Returns splats that compress as badly as real ones.
fn scene(count: usize, sh_degree: u8) -> Splats {
    let mut splats = Splats { sh_degree, ..Splats::default() };
    let mut state = 1u32;
    let mut random = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    for _ in 0..count {
        splats.means_m.push(Vec3::new(random(), random(), random()) * 5.0);
        splats.scales_m.push(Vec3::new(random(), random(), random()).map(|v| (v - 4.0).exp()));
        let q = Quat::from_xyzw(random(), random(), random(), random() + 2.0);
        splats.rotations.push(q.normalize());
        splats.opacities.push(random() * 0.5 + 0.5);
    }
    let numbers = count * splats.sh_coefficients() * 3;
    splats.sh = (0..numbers).map(|_| random() * 0.5).collect();
    splats
}

#[test]
fn loading_takes_at_most_twice_the_memory_of_the_scene() {
    for (format, sh_degree) in
        Format::ALL.into_iter().flat_map(|f| [0, f.max_sh_degree()].map(|degree| (f, degree)))
    {
        let splats = scene(100_000, sh_degree);
        for &variant in format.variants() {
            let bytes = format::encode_variant(format, variant, &splats).expect("a file");
            let before = CountingAllocator::live_bytes();
            CountingAllocator::reset_peak();
            let loaded = format::parse(&bytes, format).expect("a scene");
            let held = CountingAllocator::live_bytes() - before;
            let peak = CountingAllocator::peak_bytes() - before;
            assert!(
                peak <= 2 * held,
                "{format} {variant}, degree {sh_degree}: {peak} bytes for {held}"
            );
            assert_eq!(loaded.splats.len(), 100_000);
            println!(
                "{format} {variant}, degree {sh_degree}: {:.2} times",
                peak as f64 / held as f64
            );
        }
    }
}
