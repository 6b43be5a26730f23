//! Drives a [`Bridge`] over embassy-net and any asynchronous serial port: the loop that every chip
//! runs. A chip's own crate makes the network stack, the port, the flash and the random numbers, and
//! then awaits [`run`] for ever.
//!
//! Everything runs in one task: futures side by side on one [`Shared`], no lock, no allocation.

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

/// What only the chip can do.
pub trait Platform {
    /// Restarts the chip.
    fn restart(&mut self);

    /// Shows how things are, by a light.
    fn show(&mut self, light: Light);

    /// Returns how well the radio receives its peer; `None` where it does not know. [dBm]
    fn signal_dbm(&mut self) -> Option<i8>;

    /// Returns how often the serial port's own buffer has run over since the start.
    fn overruns(&mut self) -> u32 {
        0
    }

    /// Returns why the chip has started.
    fn restart_cause(&mut self) -> RestartCause {
        RestartCause::Unknown
    }

    /// Forwarding has come round once more: the watchdog, if there is one, has no reason to bite. Called
    /// each second at least by the task that carries the bytes, and by none else.
    fn feed(&mut self) {}

    /// Takes the next bytes of a new firmware, of which `first` are the beginning; returns true with
    /// the last: it is verified, and the next start is its own; `update` does both.
    ///
    /// # Errors
    /// Why it is not taken, in words; the firmware that runs stays.
    fn update(&mut self, first: bool, bytes: &[u8]) -> Result<bool, &'static str> {
        let _ = (first, bytes);
        Err("this bridge takes no firmware over the network; flash it by wire")
    }
}

/// State shown by the light; the number is how often it blinks in a period of two seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Light {
    /// On: autopilot and a client are there.
    Forwarding = 0,
    /// One blink: no network.
    NoNetwork = 1,
    /// Two blinks: no heartbeat from an autopilot.
    NoAutopilot = 2,
    /// Three blinks: nobody listens.
    NoClient = 3,
    /// Four blinks: no key yet; `vizflyt bridge configure` claims it.
    Unclaimed = 4,
    /// Fast: the companion is silent and the bridge has asked for LAND.
    Landing = 10,
}

/// The bridge and what wakes its tasks.
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
    /// Takes a bridge.
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

    /// Gives the bridge something; wakes whoever may have something to do now.
    pub fn with<T>(&self, f: impl FnOnce(&mut Bridge, HostTime) -> T) -> T {
        let result = f(&mut self.bridge.borrow_mut(), now());
        for wake in [&self.uart, &self.udp, &self.silent, &self.timer].into_iter().chain(&self.tcp)
        {
            wake.signal(());
        }
        result
    }

    /// Takes something from the bridge; wakes nobody.
    fn take<T>(&self, f: impl FnOnce(&mut Bridge, HostTime) -> T) -> T {
        f(&mut self.bridge.borrow_mut(), now())
    }
}

/// Memory of the sockets and of what goes through them.
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

/// Memory of the socket to those who do not speak: smaller datagrams, one at a time.
#[derive(Debug)]
struct SendOnly {
    meta: [PacketMetadata; 1],
    bytes: [u8; SILENT],
    datagram: [u8; SILENT],
}

/// The longest packet fits. [bytes]
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

/// Sockets of a bridge, for a stack's `StackResources`: UDP in, out to those who speak and to the
/// others; TCP; the page; and what the stack needs itself (DHCP).
pub const SOCKETS: usize = 5 + TCP_SLOTS;

/// What a bridge of ours may take of a chip's RAM: state and buffers. The ESP8266 has the smaller set of
/// `capacity`. [bytes]
pub const RAM_BUDGET: usize = 1024 * if cfg!(feature = "small") { 22 } else { 32 };
const _: () = assert!(
    core::mem::size_of::<Shared>() + core::mem::size_of::<Buffers>() <= RAM_BUDGET,
    "the bridge outgrows its chip: shrink a ring or a buffer"
);

/// Runs the bridge for ever: serial port, network, flash and light.
pub async fn run<R: Read, W: Write, F: NorFlash, P: Platform>(
    shared: &Shared,
    stack: Stack<'_>,
    (uart_in, uart_out): (R, W),
    store: &mut Store<F>,
    platform: &mut P,
    buffers: &mut Buffers,
) -> ! {
    // Borrowed for a call at a time, never while waiting.
    let platform = RefCell::new(platform);
    join3(
        serial(shared, uart_in, uart_out),
        serve(shared, stack, &platform, buffers),
        mind(shared, stack, store, &platform),
    )
    .await;
    // Each of the three is endless.
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
                // An overrun, or a line that is not there: the checksum finds what is missing.
                // A pause, so that a port that fails at once does not starve the rest.
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

/// Keeps the bridge's time, its settings and its light.
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
        // Asking the radio is slow on some chips; this loop turns with every packet.
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
                // The answer goes out first.
                Timer::after(Duration::from_millis(300)).await;
                platform.borrow_mut().restart();
            }
            None => {
                wait(&shared.timer, Some(due)).await;
            }
        }
    }
}

/// Ground stations and companions listen here.
const BEACON_PORT: u16 = 14550;

/// Returns what the light shows.
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

/// Waits until woken, or until `due`.
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

/// Returns the moment on embassy's clock, a tick later rather than earlier: nothing is due yet
/// just before it.
fn instant(at: HostTime) -> Instant {
    Instant::from_micros(at.as_ns().div_ceil(1000))
}
