//! Loading a scene takes at most twice the memory that it takes once loaded. (The file itself is
//! mapped: its pages are the system's to drop.) Alone in its binary, which counts every allocation.

use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use glam::{Quat, Vec3};
use vizflyt_splat::Splats;
use vizflyt_splat::format::{self, Format};

/// Bytes allocated now, and the most since the mark was last set.
static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

mod ffi {
    use std::alloc::{GlobalAlloc, Layout, System};

    use super::{NOW, PEAK, Relaxed};

    struct Counting;

    #[global_allocator]
    static ALLOCATOR: Counting = Counting;

    fn grow(bytes: usize) {
        let now = NOW.fetch_add(bytes, Relaxed) + bytes;
        PEAK.fetch_max(now, Relaxed);
    }

    // SAFETY: every call goes to the system's allocator unchanged; only sizes are counted besides.
    unsafe impl GlobalAlloc for Counting {
        unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
            grow(layout.size());
            // SAFETY: the caller's promise about `layout` is handed on.
            unsafe { System.alloc(layout) }
        }

        unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
            grow(layout.size());
            // SAFETY: as above.
            unsafe { System.alloc_zeroed(layout) }
        }

        unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
            NOW.fetch_sub(layout.size(), Relaxed);
            // SAFETY: `at` came from `System` with this layout.
            unsafe { System.dealloc(at, layout) }
        }

        unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
            // Counted as if both existed for a moment, as they may.
            grow(size);
            NOW.fetch_sub(layout.size(), Relaxed);
            // SAFETY: `at` came from `System` with this layout.
            unsafe { System.realloc(at, layout, size) }
        }
    }
}

/// Splats that compress as badly as real ones.
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
fn a_load_takes_at_most_twice_the_scene() {
    for (format, sh_degree) in
        Format::ALL.into_iter().flat_map(|f| [0, f.max_sh_degree()].map(|degree| (f, degree)))
    {
        let splats = scene(100_000, sh_degree);
        for &variant in format.variants() {
            let bytes = format::encode_variant(format, variant, &splats).expect("a file");
            let before = NOW.load(Relaxed);
            PEAK.store(before, Relaxed);
            let loaded = format::parse(&bytes, format).expect("a scene");
            let held = NOW.load(Relaxed) - before;
            let peak = PEAK.load(Relaxed) - before;
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
