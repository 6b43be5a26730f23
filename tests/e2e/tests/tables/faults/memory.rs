//! Counts the bytes that each thread has allocated and not freed. A virtual world is one thread.

use vizflyt_fixtures::CountingAllocator;

/// Returns the bytes that this thread has allocated, minus those it has freed.
pub(crate) fn live() -> isize {
    CountingAllocator::thread_live_bytes()
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;
