//! embassy's clock: extends the platform's 32-bit microseconds to 64 bits, and holds the queue of timers.

use core::cell::RefCell;
use core::task::Waker;

use critical_section::Mutex;
use embassy_time_driver::Driver;
use embassy_time_queue_utils::Queue;

use crate::platform;

struct Clock(Mutex<RefCell<State>>);

struct State {
    now_us: u64,
    read_us: u32,
    queue: Queue,
}

embassy_time_driver::time_driver_impl!(static CLOCK: Clock = Clock(Mutex::new(RefCell::new(State {
    now_us: 0,
    read_us: 0,
    queue: Queue::new(),
}))));

impl State {
    /// Updates the 64-bit count. Must be called at least once in 71 minutes.
    fn advance(&mut self) -> u64 {
        let read_us = platform::time_us();
        self.now_us += u64::from(read_us.wrapping_sub(self.read_us));
        self.read_us = read_us;
        self.now_us
    }
}

impl Driver for Clock {
    fn now(&self) -> u64 {
        critical_section::with(|section| self.0.borrow_ref_mut(section).advance())
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        critical_section::with(|section| {
            // The current poll ends with `next_expiration`, so no alarm is necessary.
            let _ = self.0.borrow_ref_mut(section).queue.schedule_wake(at, waker);
        });
    }
}

/// Wakes the tasks with expired timers. Returns the time until the next one [us].
pub(crate) fn wake_due() -> u32 {
    critical_section::with(|section| {
        let mut state = CLOCK.0.borrow_ref_mut(section);
        let now_us = state.advance();
        let next_us = state.queue.next_expiration(now_us);
        u32::try_from(next_us.saturating_sub(now_us)).unwrap_or(u32::MAX)
    })
}
