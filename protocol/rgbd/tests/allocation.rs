//! Depth allocates nothing once the scratch memory has grown to the image's size. (Colour
//! allocates inside the JPEG libraries, a handful of small buffers an image.)

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use vizflyt_rgbd::{Decoder, EncodeOptions, Encoder, RgbdView};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: every call goes to the system's allocator unchanged; the counter itself is const and
// without destructor, so it allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract is the system allocator's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's contract is the system allocator's.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's contract is the system allocator's.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn depth_allocates_for_the_first_image_only() {
    let depth_mm: Vec<u16> = (0..320 * 240).map(|n| (n * 7919 % 9000) as u16).collect();
    let view = RgbdView { width: 320, height: 240, rgb: &[], depth_mm: &depth_mm };
    let (mut encoder, mut decoder) = (Encoder::new(EncodeOptions::default()), Decoder::new());
    let (mut bytes, mut depth_out) = (Vec::new(), vec![0; depth_mm.len()]);
    let mut turn = || {
        let before = ALLOCATIONS.get();
        encoder.encode(&view, &mut bytes).unwrap();
        decoder.decode(&bytes, &mut [], &mut depth_out).unwrap();
        ALLOCATIONS.get() - before
    };
    assert!(turn() > 0, "the counter counts");
    for _ in 0..3 {
        assert_eq!(turn(), 0);
    }
    assert_eq!(depth_out, depth_mm);
}
