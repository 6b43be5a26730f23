//! Safe wrappers of the C functions that `include/vizflyt_platform.h` documents.

#![expect(unsafe_code, reason = "the seam to C")]

use core::ffi::CStr;

mod c {
    unsafe extern "C" {
        pub(super) safe fn platform_time_us() -> u32;
        pub(super) safe fn platform_interrupts_off() -> u32;
        pub(super) safe fn platform_interrupts_restore(state: u32);
        pub(super) safe fn platform_random() -> u32;
        pub(super) safe fn platform_wake();
        pub(super) safe fn abort() -> !;
        pub(super) safe fn platform_restart() -> !;
        pub(super) fn platform_uart_read(into: *mut u8, len: u32) -> u32;
        pub(super) fn platform_uart_write(bytes: *const u8, len: u32) -> u32;
        pub(super) safe fn platform_uart_is_idle() -> u32;
        pub(super) safe fn platform_uart_overruns() -> u32;
        pub(super) safe fn platform_uart_configure(baud: u32, flow_control: u32);
        pub(super) fn platform_mac(into: *mut u8);
        pub(super) fn platform_frame_waiting(len: *mut u32) -> *mut u8;
        pub(super) safe fn platform_frame_done();
        pub(super) safe fn platform_frame_begin() -> *mut u8;
        pub(super) safe fn platform_frame_send(len: u32);
        pub(super) safe fn platform_frame_drop();
        pub(super) fn platform_wifi_station(ssid: *const u8, password: *const u8) -> i32;
        pub(super) fn platform_wifi_access_point(
            ssid: *const u8,
            password: *const u8,
            channel: u32,
        ) -> i32;
        pub(super) safe fn platform_link_up() -> u32;
        pub(super) safe fn platform_rssi_dbm() -> i32;
        pub(super) safe fn platform_led(on: u32);
        pub(super) fn platform_flash_read(address: u32, into: *mut u8, len: u32) -> i32;
        pub(super) fn platform_flash_write(address: u32, bytes: *const u8, len: u32) -> i32;
        pub(super) safe fn platform_flash_erase(sector: u32) -> i32;
    }
}

/// Returns the time since an arbitrary start [us]; wraps after 71 minutes.
pub(crate) fn time_us() -> u32 {
    c::platform_time_us()
}

/// Returns 32 random bits.
pub(crate) fn random() -> u32 {
    c::platform_random()
}

/// Requests another poll.
pub(crate) fn wake() {
    c::platform_wake();
}

/// Restarts the chip or stops the emulator, after a fatal error.
pub(crate) fn abort() -> ! {
    c::abort()
}

/// Restarts the chip.
pub(crate) fn restart() -> ! {
    c::platform_restart()
}

/// Copies received bytes. Returns their number.
pub(crate) fn uart_read(into: &mut [u8]) -> usize {
    // SAFETY: the C side writes at most `len` bytes into the slice.
    unsafe { c::platform_uart_read(into.as_mut_ptr(), into.len() as u32) as usize }
}

/// Queues bytes to send. Returns the number of accepted bytes.
pub(crate) fn uart_write(bytes: &[u8]) -> usize {
    // SAFETY: the C side reads at most `len` bytes of the slice.
    unsafe { c::platform_uart_write(bytes.as_ptr(), bytes.len() as u32) as usize }
}

/// Whether all queued bytes were sent.
pub(crate) fn uart_is_idle() -> bool {
    c::platform_uart_is_idle() != 0
}

/// Returns the number of overruns, each of which lost received bytes. Wraps.
pub(crate) fn uart_overruns() -> u32 {
    c::platform_uart_overruns()
}

/// Sets baud rate and flow control.
pub(crate) fn uart_configure(baud: u32, flow_control: bool) {
    c::platform_uart_configure(baud, u32::from(flow_control));
}

/// Returns the MAC address of the interface.
pub(crate) fn mac() -> [u8; 6] {
    let mut mac = [0; 6];
    // SAFETY: the C side writes six bytes.
    unsafe { c::platform_mac(mac.as_mut_ptr()) };
    mac
}

/// Length of an Ethernet frame without its checksum: 14 bytes of header, 1500 of payload.
pub(crate) const FRAME: usize = 1514;

/// Whether a received frame waits.
pub(crate) fn is_frame_waiting() -> bool {
    let mut len = 0;
    // SAFETY: the C side writes one number.
    !unsafe { c::platform_frame_waiting(&raw mut len) }.is_null()
}

/// Passes the oldest received frame to `f` and releases it. The slice is empty if none waits.
pub(crate) fn with_frame<R>(f: impl FnOnce(&mut [u8]) -> R) -> R {
    let mut len = 0;
    // SAFETY: the C side writes one number.
    let frame = unsafe { c::platform_frame_waiting(&raw mut len) };
    if frame.is_null() {
        return f(&mut []);
    }
    // SAFETY: `len` bytes from there belong to this function until `platform_frame_done`, which follows `f`.
    let result = f(unsafe { core::slice::from_raw_parts_mut(frame, len as usize) });
    c::platform_frame_done();
    result
}

/// Buffer of a frame to send. Dropping it returns the buffer unsent.
pub(crate) struct FrameToSend(*mut u8);

/// Returns a buffer for a frame of up to [`FRAME`] bytes, if one can be sent; only one at a time.
pub(crate) fn frame_to_send() -> Option<FrameToSend> {
    let room = c::platform_frame_begin();
    (!room.is_null()).then_some(FrameToSend(room))
}

impl FrameToSend {
    /// Lets `f` write a frame of `len` bytes, and sends it.
    pub(crate) fn send<R>(self, len: usize, f: impl FnOnce(&mut [u8]) -> R) -> R {
        assert!(len <= FRAME);
        // SAFETY: the C side reserves `FRAME` bytes there until the frame is sent or dropped.
        let result = f(unsafe { core::slice::from_raw_parts_mut(self.0, len) });
        c::platform_frame_send(len as u32);
        core::mem::forget(self);
        result
    }
}

impl Drop for FrameToSend {
    fn drop(&mut self) {
        c::platform_frame_drop();
    }
}

pub(crate) fn wifi_station(ssid: &CStr, password: &CStr) -> bool {
    // SAFETY: both end in a zero and are only read.
    unsafe { c::platform_wifi_station(ssid.as_ptr().cast(), password.as_ptr().cast()) == 0 }
}

pub(crate) fn wifi_access_point(ssid: &CStr, password: &CStr, channel: u8) -> bool {
    // SAFETY: as above.
    unsafe {
        c::platform_wifi_access_point(
            ssid.as_ptr().cast(),
            password.as_ptr().cast(),
            u32::from(channel),
        ) == 0
    }
}

/// Whether the radio has joined or opened a network.
pub(crate) fn is_link_up() -> bool {
    c::platform_link_up() != 0
}

/// Returns the signal strength [dBm].
pub(crate) fn rssi_dbm() -> Option<i8> {
    match c::platform_rssi_dbm() {
        0 => None,
        dbm => Some(dbm.clamp(-128, -1) as i8),
    }
}

pub(crate) fn led(on: bool) {
    c::platform_led(u32::from(on));
}

/// Reads flash. Returns whether it succeeded.
pub(crate) fn flash_read(address: u32, into: &mut [u8]) -> bool {
    // SAFETY: the C side writes at most `len` bytes into the slice.
    unsafe { c::platform_flash_read(address, into.as_mut_ptr(), into.len() as u32) == 0 }
}

/// Writes erased flash. Returns whether it succeeded.
pub(crate) fn flash_write(address: u32, bytes: &[u8]) -> bool {
    // SAFETY: the C side only reads the slice.
    unsafe { c::platform_flash_write(address, bytes.as_ptr(), bytes.len() as u32) == 0 }
}

/// Erases a sector of 4096 bytes. Returns whether it succeeded.
pub(crate) fn flash_erase(sector: u32) -> bool {
    c::platform_flash_erase(sector) == 0
}

struct InterruptsOff;
critical_section::set_impl!(InterruptsOff);

// SAFETY: with interrupts off, no other code runs on the chip's only core; the state is restored in reverse order.
unsafe impl critical_section::Impl for InterruptsOff {
    unsafe fn acquire() -> u32 {
        c::platform_interrupts_off()
    }

    unsafe fn release(state: u32) {
        c::platform_interrupts_restore(state);
    }
}
