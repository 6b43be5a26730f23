//! Drives a [`Bridge`] over embassy-net and any asynchronous serial port: the main loop of every chip. A chip's crate
//! creates network stack, port, flash and random numbers, and then awaits [`run`] forever.
//!
//! Everything runs in one task: concurrent futures on one [`Shared`], without locks or allocation.

mod network;
mod page;

use core::cell::RefCell;
use core::net::SocketAddrV4;

use embassy_futures::join::{join, join3};
use embassy_futures::select::select;
use embassy_net::Stack;
use embassy_net::udp::PacketMetadata;
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::signal::Signal;
use embassy_time::{Duration, Instant, Timer};
use embedded_io_async::{Read, Write};
use embedded_storage::nor_flash::NorFlash;
use network::serve;
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

use crate::bridge::{Bridge, Event, TCP_SLOTS};
use crate::http::Request;
use crate::page::Response;
use crate::stats::RestartCause;
use crate::storage::Store;

/// Functions that only the chip can provide.
pub trait Platform {
    /// Restarts the chip.
    fn restart(&mut self);

    /// Shows the state of the bridge by a light.
    fn show(&mut self, light: Light);

    /// Returns the radio's received signal strength [dBm]; `None` if unknown.
    fn signal_dbm(&mut self) -> Option<i8>;

    /// Returns the number of overruns of the serial port's own buffer since the start.
    fn overruns(&mut self) -> u32 {
        0
    }

    /// Returns the cause of the chip's start.
    fn restart_cause(&mut self) -> RestartCause {
        RestartCause::Unknown
    }

    /// Resets the watchdog, if there is one. Called at least once a second, only by the task that forwards bytes.
    fn feed(&mut self) {}

    /// Takes the next bytes of a new firmware; `first` marks its beginning. Returns true with the last bytes, when the
    /// firmware is verified and will run at the next start; [`crate::update`] implements both.
    ///
    /// # Errors
    /// Why the firmware is rejected, in words. The running firmware stays.
    fn update(&mut self, first: bool, bytes: &[u8]) -> Result<bool, &'static str> {
        let _ = (first, bytes);
        Err("this bridge does not accept firmware over the network; flash it by wire")
    }
}

/// State that the light shows. The number is the count of blinks in a period of two seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Light {
    /// On: autopilot and client are connected.
    Forwarding = 0,
    /// One blink: no network.
    NoNetwork = 1,
    /// Two blinks: no heartbeat from an autopilot.
    NoAutopilot = 2,
    /// Three blinks: no client.
    NoClient = 3,
    /// Four blinks: no key yet; `vizflyt bridge configure` claims it.
    Unclaimed = 4,
    /// Fast: the companion is silent and the bridge has requested LAND.
    Landing = 10,
}

/// The bridge, and the signals that wake its tasks.
#[allow(missing_debug_implementations)] // Why: embassy's signals have none.
pub struct Shared {
    bridge: RefCell<Bridge>,
    uart: Wake,
    udp: Wake,
    silent: Wake,
    tcp: [Wake; TCP_SLOTS],
    timer: Wake,
}

type Wake = Signal<NoopRawMutex, ()>;

impl Shared {
    pub const fn new(bridge: Bridge) -> Self {
        Self {
            bridge: RefCell::new(bridge),
            uart: Wake::new(),
            udp: Wake::new(),
            silent: Wake::new(),
            tcp: [const { Wake::new() }; TCP_SLOTS],
            timer: Wake::new(),
        }
    }

    /// Passes an input to the bridge, and wakes all tasks that may have work.
    pub fn with<T>(&self, f: impl FnOnce(&mut Bridge, HostTime) -> T) -> T {
        let result = f(&mut self.bridge.borrow_mut(), now());
        for wake in [&self.uart, &self.udp, &self.silent, &self.timer].into_iter().chain(&self.tcp)
        {
            wake.signal(());
        }
        result
    }

    /// Reads an output of the bridge, without waking tasks.
    fn take<T>(&self, f: impl FnOnce(&mut Bridge, HostTime) -> T) -> T {
        f(&mut self.bridge.borrow_mut(), now())
    }
}

/// Memory of the sockets and their data.
#[derive(Debug)]
pub struct Buffers {
    udp_in_meta: [PacketMetadata; 16],
    udp_in: [u8; 2048],
    udp_out_meta: [PacketMetadata; 4],
    udp_out: [u8; 1472],
    datagram_out: [u8; 1400],
    silent: SendOnly,
    tcp: [TcpBuffers; TCP_SLOTS],
    page: PageBuffers,
}

/// Memory of the socket for silent clients: smaller datagrams, one at a time.
#[derive(Debug)]
struct SendOnly {
    meta: [PacketMetadata; 1],
    bytes: [u8; SILENT],
    datagram: [u8; SILENT],
}

/// Length of the longest packet, rounded up [bytes].
const SILENT: usize = 300;

#[derive(Debug)]
struct PageBuffers {
    receive: [u8; 536],
    transmit: [u8; 536],
    chunk: [u8; 128],
    request: Request,
    answer: Response,
}

#[derive(Debug)]
struct TcpBuffers {
    receive: [u8; 536],
    transmit: [u8; 1072],
    batch: [u8; 536],
}

impl Default for Buffers {
    fn default() -> Self {
        Self::new()
    }
}

impl Buffers {
    /// Empty buffers; `const`, for a chip's static memory.
    pub const fn new() -> Self {
        Self {
            udp_in_meta: [PacketMetadata::EMPTY; 16],
            udp_in: [0; 2048],
            udp_out_meta: [PacketMetadata::EMPTY; 4],
            udp_out: [0; 1472],
            datagram_out: [0; 1400],
            silent: SendOnly {
                meta: [PacketMetadata::EMPTY],
                bytes: [0; SILENT],
                datagram: [0; SILENT],
            },
            tcp: [const { TcpBuffers { receive: [0; 536], transmit: [0; 1072], batch: [0; 536] } };
                TCP_SLOTS],
            page: PageBuffers {
                receive: [0; 536],
                transmit: [0; 536],
                chunk: [0; 128],
                request: Request::new(),
                answer: Response::new(),
            },
        }
    }
}

/// Number of sockets, for a stack's `StackResources`: UDP input, UDP output to active and to silent clients, TCP, the
/// web page, and the stack's own (DHCP).
pub const SOCKETS: usize = 5 + TCP_SLOTS;

/// RAM budget of a bridge: state and buffers [bytes]. The ESP8266 uses the smaller set of `capacity`.
pub const RAM_BUDGET: usize = 1024 * if cfg!(feature = "small") { 22 } else { 32 };
const _: () = assert!(
    core::mem::size_of::<Shared>() + core::mem::size_of::<Buffers>() <= RAM_BUDGET,
    "the bridge outgrows its chip: shrink a ring or a buffer"
);

/// Runs the bridge forever: serial port, network, flash and light.
pub async fn run<R: Read, W: Write, F: NorFlash, P: Platform>(
    shared: &Shared,
    stack: Stack<'_>,
    (uart_in, uart_out): (R, W),
    store: &mut Store<F>,
    platform: &mut P,
    buffers: &mut Buffers,
) -> ! {
    // Borrowed only during a call, never across an await.
    let platform = RefCell::new(platform);
    join3(
        serial(shared, uart_in, uart_out),
        serve(shared, stack, &platform, buffers),
        mind(shared, stack, store, &platform),
    )
    .await;
    // Unreachable: none of the three ends.
    core::future::pending().await
}

/// Carries bytes between the bridge and the autopilot's port.
async fn serial<R: Read, W: Write>(shared: &Shared, mut uart_in: R, mut uart_out: W) {
    let receive = async {
        let mut bytes = [0; 128];
        loop {
            match uart_in.read(&mut bytes).await {
                Ok(len) if len > 0 => {
                    shared.with(|bridge, now| bridge.handle_uart(now, &bytes[..len]));
                }
                // An overrun or a disconnected line: checksums detect the missing bytes. The pause keeps a port that
                // fails immediately from starving other tasks.
                _ => Timer::after(Duration::from_millis(1)).await,
            }
        }
    };
    let send = async {
        let mut packet = [0; MAX_PACKET];
        loop {
            match shared.take(|bridge, now| bridge.poll_uart(now, &mut packet)) {
                0 => shared.uart.wait().await,
                len => {
                    if uart_out.write_all(&packet[..len]).await.is_err() {
                        shared.take(|bridge, _| bridge.note_not_sent());
                        Timer::after(Duration::from_millis(1)).await;
                    }
                }
            }
        }
    };
    join(receive, send).await;
}

/// Runs timeouts and events of the bridge, and updates the light.
async fn mind<F: NorFlash, P: Platform>(
    shared: &Shared,
    stack: Stack<'_>,
    store: &mut Store<F>,
    platform: &RefCell<&mut P>,
) {
    let mut shown = None;
    let mut signal = platform.borrow_mut().signal_dbm();
    let mut asked_at = Instant::now();
    let cause = platform.borrow_mut().restart_cause();
    shared.take(|bridge, _| bridge.set_restart_cause(cause));
    loop {
        platform.borrow_mut().feed();
        let overruns = platform.borrow_mut().overruns();
        // Reading the radio is slow on some chips, and this loop runs for every packet.
        if asked_at.elapsed() > Duration::from_secs(1) {
            signal = platform.borrow_mut().signal_dbm();
            asked_at = Instant::now();
        }
        let network = stack.config_v4().map(|config| config.address);
        let broadcast = network.map(|network| {
            let address = network.broadcast().unwrap_or(core::net::Ipv4Addr::BROADCAST);
            SocketAddrV4::new(address, BEACON_PORT)
        });
        let (event, light, due) = shared.take(|bridge, now| {
            bridge.set_network(broadcast);
            bridge.set_address(network.map(|network| network.address()));
            bridge.set_signal(signal);
            bridge.set_overruns(overruns);
            bridge.handle_timeout(now);
            (bridge.poll_event(), light(bridge, broadcast.is_some()), bridge.poll_timeout())
        });
        shared.uart.signal(());
        shared.udp.signal(());
        shared.silent.signal(());
        if shown != Some(light) {
            platform.borrow_mut().show(light);
            shown = Some(light);
        }
        match event {
            Some(Event::Save) => {
                let saved = shared.take(|bridge, _| store.save(bridge.settings()).is_ok());
                shared.with(|bridge, now| bridge.note_saved(now, saved));
            }
            Some(Event::Restart) => {
                // Send the answer first.
                Timer::after(Duration::from_millis(300)).await;
                platform.borrow_mut().restart();
            }
            None => {
                wait(&shared.timer, Some(due)).await;
            }
        }
    }
}

/// Port of ground stations and companions.
const BEACON_PORT: u16 = 14550;

/// Returns the state for the light.
pub fn light(bridge: &Bridge, network: bool) -> Light {
    if bridge.landing().is_some() {
        Light::Landing
    } else if !network {
        Light::NoNetwork
    } else if bridge.autopilot().is_none() && !bridge.is_transparent() {
        Light::NoAutopilot
    } else if bridge.clients().next().is_none() {
        Light::NoClient
    } else if bridge.settings().key.is_none() {
        Light::Unclaimed
    } else {
        Light::Forwarding
    }
}

/// Waits until woken or until `due`.
async fn wait(wake: &Wake, due: Option<HostTime>) {
    match due {
        Some(due) => {
            select(wake.wait(), Timer::at(instant(due))).await;
        }
        None => wake.wait().await,
    }
}

fn now() -> HostTime {
    HostTime::from_ns(Instant::now().as_micros() * 1000)
}

/// Converts a time to embassy's clock. Rounds up, because nothing is due a tick earlier.
fn instant(at: HostTime) -> Instant {
    Instant::from_micros(at.as_ns().div_ceil(1000))
}
