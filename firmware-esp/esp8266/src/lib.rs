//! The bridge on an ESP8266: the shared core behind a small C interface.
//!
//! ```text
//! C (QEMU's semihosting, or the vendor's SDK)        Rust, one object for both
//! main loop ── vizflyt_poll ──────────────────────▶ executor: network, bridge, light
//! radio ◀───── platform_frame_waiting, _send ───────▶ embassy-net ─▶ sockets
//! UART ◀────── platform_uart_read, _write ──────────▶ bridge
//! ```
//! The main loop calls [`vizflyt_poll`] after every event and when a timer is due. Nothing here blocks, allocates, or
//! runs in an interrupt.

#![no_std]

mod clock;
mod flash;
mod front;
mod platform;
mod radio;
mod uart;

use core::cell::Cell;
use core::panic::PanicInfo;

use critical_section::Mutex;
use embassy_executor::raw::Executor;
use embassy_net::{Config, Runner, Stack, StackResources};
use static_cell::{ConstStaticCell, StaticCell};
use vizflyt_bridge::shell::{self, Buffers, Shared};
use vizflyt_bridge::storage::Store;
use vizflyt_bridge::{Bridge, Chip, Settings, blink, wifi};

/// Settings' region in the flash; see the SDK's map in `sdk/platform.c`.
const SETTINGS: flash::Region = flash::Region { start: 0x3F_0000, len: 2 * flash::SECTOR };

/// The executor. It belongs to the loop that calls [`vizflyt_poll`].
#[derive(Clone, Copy)]
struct Loop(&'static Executor);

#[expect(unsafe_code, reason = "one core and one thread of control")]
// SAFETY: the chip has one core, and interrupts access the executor only through `pender`.
unsafe impl Send for Loop {}

static RUNNING: Mutex<Cell<Option<Loop>>> = Mutex::new(Cell::new(None));

#[expect(unsafe_code, reason = "called by the executor to request a poll")]
#[unsafe(export_name = "__pender")]
fn pender(_context: *mut ()) {
    platform::wake();
}

/// Builds network, bridge and tasks. See `include/vizflyt_platform.h`.
#[expect(unsafe_code, reason = "called from C")]
#[unsafe(no_mangle)]
pub extern "C" fn vizflyt_start() {
    let (stack, runner) = start_network();
    start_tasks(stack, runner);
}

type Network = Runner<'static, &'static mut radio::Radio>;

/// Creates the network stack. Not inlined, because it uses the most of the chip's stack.
#[inline(never)]
fn start_network() -> (Stack<'static>, Network) {
    static RESOURCES: StaticCell<StackResources<{ shell::SOCKETS + wifi::SOCKETS }>> =
        StaticCell::new();
    static RADIO: StaticCell<radio::Radio> = StaticCell::new();
    let seed = u64::from(platform::random()) << 32 | u64::from(platform::random());
    let radio = RADIO.init(radio::Radio::new(platform::mac()));
    embassy_net::new(radio, Config::default(), RESOURCES.init_with(StackResources::new), seed)
}

/// Builds the bridge and spawns all tasks.
#[inline(never)]
fn start_tasks(stack: Stack<'static>, runner: Network) {
    static EXECUTOR: StaticCell<Executor> = StaticCell::new();
    static SHARED: ConstStaticCell<Shared> = ConstStaticCell::new(Shared::new(Bridge::empty()));
    static BUFFERS: ConstStaticCell<Buffers> = ConstStaticCell::new(Buffers::new());
    static WIFI: ConstStaticCell<wifi::Buffers> = ConstStaticCell::new(wifi::Buffers::new());

    let mut random = [0; 16];
    for word in random.chunks_exact_mut(4) {
        word.copy_from_slice(&platform::random().to_le_bytes());
    }
    let chip = Chip { address: platform::mac(), random };
    let shared = SHARED.take();
    let mut store = Store::new(SETTINGS, 0);
    let load = |settings: &mut Settings| {
        // Without saved settings, the defaults stay.
        let _ = store.load_into(settings);
        platform::uart_configure(settings.baud, settings.flow_control);
    };
    shared.with(|bridge, now| bridge.begin(now, chip, load));

    let executor: &'static Executor = EXECUTOR.init(Executor::new(core::ptr::null_mut()));
    critical_section::with(|section| RUNNING.borrow(section).set(Some(Loop(executor))));
    let spawner = executor.spawner();
    // Cannot fail: each task is spawned once.
    spawner.spawn(network(runner).unwrap());
    spawner.spawn(join_networks(shared, stack, WIFI.take()).unwrap());
    spawner.spawn(forward(shared, stack, store, BUFFERS.take()).unwrap());
    spawner.spawn(light().unwrap());
}

/// Runs every task that can make progress. Returns the time until the next timer [us].
#[expect(unsafe_code, reason = "called from C")]
#[unsafe(no_mangle)]
pub extern "C" fn vizflyt_poll(events: u32) -> u32 {
    if events & UART_READABLE != 0 {
        uart::readable();
    }
    if events & UART_WRITABLE != 0 {
        uart::writable();
    }
    if events & (FRAMES | LINK) != 0 {
        radio::changed();
    }
    clock::wake_due();
    if let Some(Loop(executor)) = critical_section::with(|section| RUNNING.borrow(section).get()) {
        // SAFETY: one thread of control, and no platform function calls back into this one.
        unsafe { executor.poll() };
    }
    clock::wake_due()
}

const UART_READABLE: u32 = 1;
const UART_WRITABLE: u32 = 2;
const FRAMES: u32 = 4;
const LINK: u32 = 8;

#[embassy_executor::task]
async fn network(mut runner: Network) {
    runner.run().await;
}

#[embassy_executor::task]
async fn forward(
    shared: &'static Shared,
    stack: Stack<'static>,
    mut store: Store<flash::Region>,
    buffers: &'static mut Buffers,
) {
    let uart = (uart::Receiver, uart::Sender);
    shell::run(shared, stack, uart, &mut store, &mut front::Front, buffers).await;
}

#[embassy_executor::task]
async fn join_networks(
    shared: &'static Shared,
    stack: Stack<'static>,
    buffers: &'static mut wifi::Buffers,
) {
    wifi::run(shared, stack, &mut radio::Control, buffers).await;
}

#[embassy_executor::task]
async fn light() {
    blink::run(front::light, platform::led).await;
}

/// Never linked: panics abort in place (see `build`), but the compiler requires a handler.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    platform::abort()
}
