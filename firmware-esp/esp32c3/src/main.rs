//! The bridge on an ESP32-C3: pins, radio, flash and executor around the shared core.
//!
//! ```text
//! GPIO4 ──▶ autopilot RX      GPIO5 ◀── autopilot TX       UART1, 921600 baud
//! GPIO6 RTS ──▶ CTS           GPIO7 CTS ◀── RTS            only with UART_FLOW
//!                             other pins: UART_TX_PIN, ...
//! GPIO10 LED to ground, GPIO8 LED to 3.3 V (on most boards)
//! GPIO9 BOOT button: hold for five seconds to erase the settings
//! USB: log, and flashing
//! ```
//! An interrupt receives the autopilot's bytes, the radio runs in threads of the scheduler, and the bridge runs in
//! tasks of the main thread. A panic, or forwarding that hangs, restarts the chip.

#![no_std]
#![no_main]

extern crate alloc;

mod flash;
mod front;
mod pins;
mod radio;
mod restart;
mod serial;
mod update;

use core::cell::RefCell;

use embassy_executor::Spawner;
use embassy_net::{Runner, Stack, StackResources};
use embassy_time::{Duration, Timer};
use esp_backtrace as _;
use esp_hal::clock::CpuClock;
use esp_hal::gpio::{Input, InputConfig, Level, Output, OutputConfig, Pin as _, Pull};
use esp_hal::interrupt::Priority;
use esp_hal::ram;
use esp_hal::rng::Rng;
use esp_hal::timer::timg::TimerGroup;
use esp_hal::uart::{Uart, UartTx};
use esp_hal::{Blocking, efuse};
use esp_println::println;
use esp_radio::wifi::{ControllerConfig, CountryInfo, WifiController};
use esp_rtos::embassy::InterruptExecutor;
use esp_storage::FlashStorage;
use static_cell::{ConstStaticCell, StaticCell};
use vizflyt_bridge::shell::{self, Buffers, Shared};
use vizflyt_bridge::storage::Store;
use vizflyt_bridge::{Bridge, Chip, blink, wifi};

esp_bootloader_esp_idf::esp_app_desc!();

/// Heap for the radio's driver, its queues and threads [bytes]. The first part reuses memory of the chip's bootloader.
const RECLAIMED_BYTES: usize = 64 * 1024;
const HEAP_BYTES: usize = 48 * 1024;
/// Worldwide regulatory domain: channels 1 to 11.
const ANYWHERE: &[u8; 2] = b"01";
/// Time on the network after which a new firmware is kept.
const TRIAL: Duration = Duration::from_secs(30);

#[esp_rtos::main]
async fn main(spawner: Spawner) -> ! {
    static FLASH: StaticCell<flash::Flash> = StaticCell::new();
    static URGENT: StaticCell<InterruptExecutor<1>> = StaticCell::new();
    static RESOURCES: StaticCell<StackResources<{ shell::SOCKETS + wifi::SOCKETS }>> =
        StaticCell::new();
    static SHARED: ConstStaticCell<Shared> = ConstStaticCell::new(Shared::new(Bridge::empty()));
    static BUFFERS: ConstStaticCell<Buffers> = ConstStaticCell::new(Buffers::new());
    static WIFI: ConstStaticCell<wifi::Buffers> = ConstStaticCell::new(wifi::Buffers::new());

    let chip = esp_hal::init(esp_hal::Config::default().with_cpu_clock(CpuClock::max()));
    let cause = restart::cause();
    let watchdog = restart::Watchdog::start(TimerGroup::new(chip.TIMG1).wdt);
    let flash: &'static flash::Flash =
        FLASH.init_with(|| RefCell::new(FlashStorage::new(chip.FLASH)));
    let on_trial = update::start(flash);
    esp_alloc::heap_allocator!(#[ram(reclaimed)] size: RECLAIMED_BYTES);
    esp_alloc::heap_allocator!(size: HEAP_BYTES);
    // The radio's driver needs the scheduler first.
    esp_rtos::start(TimerGroup::new(chip.TIMG0).timer0, chip.FROM_CPU_INTR0);

    let mut store = Store::new(flash::settings(flash), 0);
    let settings = store.load().unwrap_or_default();

    let pins = pins::Pins([
        (0, Some(chip.GPIO0.degrade())),
        (1, Some(chip.GPIO1.degrade())),
        (2, Some(chip.GPIO2.degrade())),
        (3, Some(chip.GPIO3.degrade())),
        (4, Some(chip.GPIO4.degrade())),
        (5, Some(chip.GPIO5.degrade())),
        (6, Some(chip.GPIO6.degrade())),
        (7, Some(chip.GPIO7.degrade())),
        (20, Some(chip.GPIO20.degrade())),
        (21, Some(chip.GPIO21.degrade())),
    ])
    .take(settings.pins)
    .unwrap_or_else(|| panic!("the settings contain a pin that the port cannot use"));
    let port = Uart::new(chip.UART1, serial::config(settings.baud, settings.flow_control))
        // Cannot fail: the settings limit the baud rate to the port's range.
        .unwrap_or_else(|error| panic!("the serial port refuses {} baud: {error}", settings.baud))
        .with_tx(pins.tx)
        .with_rx(pins.rx);
    let port =
        if settings.flow_control { port.with_rts(pins.rts).with_cts(pins.cts) } else { port };
    let (receiver, sender) = port.split();
    let urgent = URGENT.init(InterruptExecutor::new(chip.FROM_CPU_INTR1));
    // Cannot fail: each task is spawned once.
    urgent.start(Priority::Priority3).spawn(serial::receive(receiver).unwrap());

    let rng = Rng::new();
    let mut random = [0; 16];
    let mut seed = [0; 8];
    let country = *settings.country.as_bytes().first_chunk().unwrap_or(ANYWHERE);
    let config = ControllerConfig::default().with_country_info(CountryInfo::from(country));
    let controller = WifiController::new(chip.WIFI, config)
        .unwrap_or_else(|error| panic!("the radio does not start: {error:?}"));
    // The generator is truly random only while the radio is on.
    rng.read(&mut random);
    rng.read(&mut seed);
    let (stack, runner) = embassy_net::new(
        radio::Radio::new(),
        embassy_net::Config::default(),
        RESOURCES.init_with(StackResources::new),
        u64::from_le_bytes(seed),
    );

    let shared: &'static Shared = SHARED.take();
    let mut address = [0; 6];
    address.copy_from_slice(efuse::base_mac_address().as_bytes());
    println!("vizflyt bridge {}, {} baud; {cause:?}", env!("CARGO_PKG_VERSION"), settings.baud);
    shared
        .with(|bridge, now| bridge.begin(now, Chip { address, random }, |place| *place = settings));

    spawner.spawn(network(runner).unwrap());
    spawner.spawn(join_networks(shared, stack, controller, WIFI.take()).unwrap());
    let front = front::Front { updates: update::Updates::new(flash), watchdog, cause };
    spawner.spawn(forward(shared, stack, sender, store, front, BUFFERS.take()).unwrap());
    if on_trial {
        spawner.spawn(settle(stack, flash).unwrap());
    }
    let led = Output::new(chip.GPIO10, Level::Low, OutputConfig::default());
    let board_led = Output::new(chip.GPIO8, Level::High, OutputConfig::default());
    let button = Input::new(chip.GPIO9, InputConfig::default().with_pull(Pull::Up));
    spawner.spawn(light(led, board_led).unwrap());
    front::watch(button, flash).await
}

#[embassy_executor::task]
async fn network(mut runner: Runner<'static, radio::Radio>) {
    runner.run().await;
}

#[embassy_executor::task]
async fn join_networks(
    shared: &'static Shared,
    stack: Stack<'static>,
    controller: WifiController<'static>,
    buffers: &'static mut wifi::Buffers,
) {
    wifi::run(shared, stack, &mut radio::Control::new(controller), buffers).await;
}

#[embassy_executor::task]
async fn forward(
    shared: &'static Shared,
    stack: Stack<'static>,
    sender: UartTx<'static, Blocking>,
    mut store: Store<flash::Region>,
    mut front: front::Front,
    buffers: &'static mut Buffers,
) {
    let port = (&serial::RECEIVED, sender.into_async());
    shell::run(shared, stack, port, &mut store, &mut front, buffers).await;
}

/// Keeps a new firmware after some time on the network: it then works well enough to accept another update.
#[embassy_executor::task]
async fn settle(stack: Stack<'static>, flash: &'static flash::Flash) {
    stack.wait_config_up().await;
    Timer::after(TRIAL).await;
    update::keep(flash);
}

#[embassy_executor::task]
async fn light(mut led: Output<'static>, mut board_led: Output<'static>) {
    blink::run(front::light, |on| {
        led.set_level(on.into());
        board_led.set_level((!on).into());
    })
    .await;
}
