//! `vizflyt bridge emulate`: the vehicle's bridge on this computer. The core is the same as on the
//! chips; here it runs between a pseudo-terminal (or a real serial port) and sockets. Only the
//! shell differs: one thread that waits on file descriptors.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use nix::libc::linger;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::socket::{setsockopt, sockopt};
use nix::sys::time::TimeSpec;
use serde_json::json;
use vizflyt_bridge::bridge::TCP_SLOTS;
use vizflyt_bridge::settings::{Key, key_from_hex};
use vizflyt_bridge::stats::REPORT;
use vizflyt_bridge::storage::Store;
use vizflyt_bridge::{Bridge, Chip, Event, Settings};
use vizflyt_process::{print_line, stop_flag};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

use super::flash::FileFlash;
use super::page::Page;
use super::port::{Port, Uart};

/// Emulate the vehicle's Wi-Fi bridge on this computer
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt bridge emulate --uart pty:/tmp/uart           then: vizflyt sim --serial /tmp/uart
  vizflyt bridge emulate --uart /dev/ttyUSB0            with a real autopilot on this computer's port
  vizflyt bridge emulate --client 127.0.0.1:14550       contact a waiting runtime first
  vizflyt bridge emulate --page 127.0.0.1:8090 --set page.key=abcd-efgh
                                                        with the status page; the key permits changes there
  vizflyt bridge emulate --set TRANSPARENT=1            pass all bytes unparsed; the bridge sends no LAND")]
pub(crate) struct EmulateArgs {
    /// Serial port of the autopilot: `pty`, `pty:PATH` or a device
    ///
    /// `pty` makes a pseudo-terminal. `pty:PATH` also links PATH to it.
    #[arg(long, help_heading = "MAVLink", value_name = "UART", default_value = "pty")]
    uart: Uart,
    /// Baud rate of the port
    ///
    /// A pseudo-terminal has the timing of a serial line at this rate.
    #[arg(long, help_heading = "MAVLink", value_name = "BAUD")]
    baud: Option<u32>,
    /// UDP address for clients
    #[arg(
        long,
        help_heading = "MAVLink",
        value_name = "ADDR:PORT",
        default_value = "127.0.0.1:14555"
    )]
    listen: SocketAddrV4,
    /// TCP address for clients [default: no TCP]
    #[arg(long, help_heading = "MAVLink", value_name = "ADDR:PORT")]
    tcp: Option<SocketAddrV4>,
    /// Client to which the bridge sends before it has received a packet
    #[arg(long, help_heading = "MAVLink", value_name = "ADDR:PORT")]
    client: Option<SocketAddrV4>,
    /// TCP address of the status page [default: no page]
    #[arg(long, help_heading = "Web page", value_name = "ADDR:PORT")]
    page: Option<SocketAddrV4>,
    /// Accept firmware signed by this key, at the page
    ///
    /// `vizflyt bridge firmware key` prints the key. Firmware is verified as on a chip, but not
    /// run.
    #[arg(long, help_heading = "Web page", value_name = "HEX", requires = "page", value_parser = firmware_key)]
    firmware_key: Option<Key>,
    /// Other setting, as in `vizflyt bridge configure`; can be repeated
    #[arg(long = "set", help_heading = "Bridge", value_name = "NAME=VALUE")]
    settings: Vec<String>,
    /// File for the bridge's flash, so that saved settings persist
    #[arg(long, help_heading = "Bridge", value_name = "FILE")]
    flash: Option<PathBuf>,
    /// Print JSON lines on stdout: one when ready, one report at the end
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// End when stdin closes
    #[arg(long, hide = true)]
    lifeline: bool,
}

impl EmulateArgs {
    /// Returns arguments for a bridge between a new pseudo-terminal and a free port on loopback.
    pub(crate) fn loopback(baud: u32) -> Self {
        Self {
            uart: Uart::Pty(None),
            listen: SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0),
            tcp: None,
            page: None,
            firmware_key: None,
            client: None,
            baud: Some(baud),
            settings: Vec::new(),
            flash: None,
            json: false,
            lifeline: false,
        }
    }
}

/// Maximum time between checks of the stop flag.
const WAKE: Duration = Duration::from_millis(50);

/// Send buffer of a TCP client on a chip: two segments. [bytes]
const TCP_BUFFER: usize = 1072;

/// Runs the emulation until it is stopped.
pub(crate) fn run(args: &EmulateArgs) -> Result<()> {
    let stop = stop_flag(args.lifeline)?;
    let mut emulation = Emulation::open(args)?;
    let uart = emulation.port.path().display().to_string();
    let udp = emulation.udp.local_addr()?.to_string();
    let tcp = match &emulation.listener {
        Some(listener) => Some(listener.local_addr()?.to_string()),
        None => None,
    };
    let page = match &emulation.page {
        Some(page) => Some(page.address()?.to_string()),
        None => None,
    };
    if args.json {
        print_line(json!({"ready": "bridge", "uart": uart, "udp": udp, "tcp": tcp, "page": page}));
    } else {
        print_line(format!(
            "bridge ready: autopilot at {uart}, clients at udp {udp}; Ctrl-C ends it"
        ));
        if let Some(tcp) = tcp {
            print_line(format!("              and tcp {tcp}"));
        }
        if let Some(page) = page {
            print_line(format!("              its page: http://{page}"));
        }
        if emulation.bridge.is_transparent() {
            print_line("              transparent: bytes pass unparsed; no priorities, no LAND");
        }
    }
    while !stop.load(Ordering::Relaxed) {
        emulation.turn()?;
        emulation.wait()?;
    }
    let report = emulation.report();
    if args.json {
        print_line(json!({ "report": report }));
    } else {
        for (name, value) in report.as_object().into_iter().flatten() {
            print_line(format!("{name:24} {value}"));
        }
    }
    Ok(())
}

/// An emulated bridge with its sockets and port.
pub(crate) struct Emulation {
    bridge: Bridge,
    overrides: Vec<(String, String)>,
    store: Store<FileFlash>,
    pub(crate) port: Port,
    pub(crate) udp: UdpSocket,
    listener: Option<TcpListener>,
    page: Option<Page>,
    streams: [Option<Connection>; TCP_SLOTS],
    start: Instant,
    booted: Instant,
}

/// TCP client with the bytes that it has not read yet.
struct Connection {
    stream: TcpStream,
    pending: Vec<u8>,
}

impl Emulation {
    /// Opens the port and all sockets.
    pub(crate) fn open(args: &EmulateArgs) -> Result<Self> {
        let mut overrides = vec![("UDP_PORT".to_owned(), args.listen.port().max(1).to_string())];
        overrides.extend(args.client.map(|client| ("client".to_owned(), client.to_string())));
        overrides.extend(args.baud.map(|baud| ("UART_BAUD".to_owned(), baud.to_string())));
        for setting in &args.settings {
            let (name, value) = setting
                .split_once('=')
                .with_context(|| format!("--set {setting}: write NAME=VALUE"))?;
            overrides.push((name.to_owned(), value.to_owned()));
        }
        let flash = FileFlash::open(args.flash.clone()).with_context(|| {
            let path = args.flash.clone().unwrap_or_default();
            format!("bridge: cannot read the flash in {}", path.display())
        })?;
        let mut store = Store::new(flash, 0);
        let settings = boot_settings(&mut store, &overrides)?;
        let port = Port::open(&args.uart, settings.baud)?;
        let udp = UdpSocket::bind(args.listen)
            .with_context(|| format!("bridge: cannot listen on {}; is it in use?", args.listen))?;
        udp.set_nonblocking(true)?;
        let listener = match args.tcp {
            Some(address) => {
                let listener = TcpListener::bind(address).with_context(|| {
                    format!("bridge: cannot listen on {address}; is it in use?")
                })?;
                listener.set_nonblocking(true)?;
                Some(listener)
            }
            None => None,
        };
        let page = args.page.map(|address| Page::open(address, args.firmware_key)).transpose()?;
        let start = Instant::now();
        let bridge = Bridge::new(HostTime::ZERO, settings, chip()?);
        Ok(Self {
            bridge,
            overrides,
            store,
            port,
            udp,
            listener,
            page,
            streams: [const { None }; TCP_SLOTS],
            start,
            booted: start,
        })
    }

    /// Handles all pending input, output and timers.
    pub(crate) fn turn(&mut self) -> Result<()> {
        let now = Instant::now();
        let at = self.host(now);
        let bridge = &mut self.bridge;
        self.port.receive(now, |bytes| bridge.handle_uart(at, bytes))?;
        self.receive_udp(at);
        self.receive_tcp(at);
        if self.page.as_mut().is_some_and(|page| page.turn(&mut self.bridge, at, now)) {
            self.restart(at)?;
        }
        if self.bridge.poll_timeout() <= at {
            self.bridge.handle_timeout(at);
        }
        let mut packet = [0; MAX_PACKET];
        while self.port.is_free(now)? {
            match self.bridge.poll_uart(at, &mut packet) {
                0 => break,
                len => self.port.send(now, &packet[..len]),
            }
        }
        let mut datagram = [0; 1472];
        while let Some((to, len)) = self.bridge.poll_udp(at, &mut datagram) {
            if self.udp.send_to(&datagram[..len], to).is_err() {
                self.bridge.note_not_sent();
            }
        }
        self.send_tcp(at);
        while let Some(event) = self.bridge.poll_event() {
            match event {
                Event::Save => {
                    let saved = self.store.save(self.bridge.settings()).is_ok();
                    self.bridge.note_saved(at, saved);
                }
                Event::Restart => self.restart(at)?,
            }
        }
        Ok(())
    }

    /// Restarts as a chip does: all state except the flash is lost.
    fn restart(&mut self, at: HostTime) -> Result<()> {
        tracing::info!("bridge: restarts");
        let settings = boot_settings(&mut self.store, &self.overrides)?;
        self.bridge = Bridge::new(at, settings, chip()?);
        self.streams = [const { None }; TCP_SLOTS];
        self.booted = Instant::now();
        Ok(())
    }

    fn receive_udp(&mut self, at: HostTime) {
        let mut bytes = [0; 2048];
        // Bounded, so that a flood does not starve the autopilot's side.
        for _ in 0..64 {
            match self.udp.recv_from(&mut bytes) {
                Ok((len, SocketAddr::V4(from))) => {
                    self.bridge.handle_datagram(at, from, &bytes[..len]);
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                // A client that has not started yet causes "connection refused": continue.
                _ => {}
            }
        }
    }

    fn receive_tcp(&mut self, at: HostTime) {
        if let Some((stream, _)) =
            self.listener.as_ref().and_then(|listener| listener.accept().ok())
            && let Some(slot) = self.streams.iter().position(Option::is_none)
            && stream.set_nonblocking(true).is_ok()
        {
            // Avoids delays of small packets; without it, the connection still works.
            let _ = stream.set_nodelay(true);
            // Same small buffer as on a chip, so that a client that does not read is detected
            // early.
            let _ = setsockopt(&stream, sockopt::SndBuf, &TCP_BUFFER);
            self.streams[slot] = Some(Connection { stream, pending: Vec::new() });
            self.bridge.open_stream(at, slot as u8);
        }
        let mut bytes = [0; 2048];
        for (slot, place) in self.streams.iter_mut().enumerate() {
            let Some(connection) = place else { continue };
            let gone = loop {
                match connection.stream.read(&mut bytes) {
                    Ok(0) => break true,
                    Ok(len) => self.bridge.handle_stream(at, slot as u8, &bytes[..len]),
                    Err(error) if error.kind() == ErrorKind::WouldBlock => break false,
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(_) => break true,
                }
            };
            if gone {
                *place = None;
                self.bridge.close_stream(slot as u8);
            }
        }
    }

    fn send_tcp(&mut self, at: HostTime) {
        for (slot, place) in self.streams.iter_mut().enumerate() {
            let Some(connection) = place else { continue };
            let gone = loop {
                if !self.bridge.is_open(slot as u8) {
                    tracing::warn!("bridge: dropped a tcp client that does not read");
                    // Abort immediately, as a chip does; unread bytes are discarded.
                    let linger = linger { l_onoff: 1, l_linger: 0 };
                    let _ = setsockopt(&connection.stream, sockopt::Linger, &linger);
                    break true;
                }
                if connection.pending.is_empty() {
                    let mut batch = [0; 1472];
                    match self.bridge.poll_tcp(at, slot as u8, &mut batch) {
                        0 => break false,
                        len => connection.pending.extend_from_slice(&batch[..len]),
                    }
                }
                match connection.stream.write(&connection.pending) {
                    Ok(0) => break true,
                    Ok(len) => drop(connection.pending.drain(..len)),
                    Err(error) if error.kind() == ErrorKind::WouldBlock => break false,
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(_) => break true,
                }
            };
            if gone {
                *place = None;
                self.bridge.close_stream(slot as u8);
            }
        }
    }

    /// Waits for input or the next timer.
    pub(crate) fn wait(&self) -> Result<()> {
        let now = Instant::now();
        let mut due = now + WAKE;
        if let Some(at) = self.port.due() {
            due = due.min(at);
        }
        let mut timeouts = vec![Some(self.bridge.poll_timeout()), self.bridge.udp_due()];
        let mut fds = Vec::new();
        if self.port.wants_input() {
            fds.push(PollFd::new(self.port.as_fd(), PollFlags::POLLIN));
        }
        fds.push(PollFd::new(self.udp.as_fd(), PollFlags::POLLIN));
        if let Some(listener) = &self.listener {
            fds.push(PollFd::new(listener.as_fd(), PollFlags::POLLIN));
        }
        if let Some(page) = &self.page {
            fds.push(PollFd::new(page.fd(), PollFlags::POLLIN));
        }
        for (slot, connection) in self.streams.iter().enumerate() {
            let Some(connection) = connection else { continue };
            let mut flags = PollFlags::POLLIN;
            if connection.pending.is_empty() {
                timeouts.push(self.bridge.tcp_due(slot as u8));
            } else {
                flags |= PollFlags::POLLOUT;
            }
            fds.push(PollFd::new(connection.stream.as_fd(), flags));
        }
        for at in timeouts.into_iter().flatten() {
            due = due.min(self.start + Duration::from_nanos(at.as_ns()));
        }
        let left = TimeSpec::from_duration(due.saturating_duration_since(now));
        match ppoll(&mut fds, Some(left), None) {
            Ok(_) | Err(nix::errno::Errno::EINTR) => Ok(()),
            Err(error) => Err(error).context("bridge: cannot wait for its sockets"),
        }
    }

    /// Returns all counters by name.
    pub(crate) fn report(&self) -> serde_json::Value {
        let counters = self.bridge.stats().report(self.booted.elapsed().as_secs() as u32);
        REPORT
            .iter()
            .zip(counters)
            .map(|(name, value)| ((*name).to_owned(), value.into()))
            .collect::<serde_json::Map<_, _>>()
            .into()
    }

    fn host(&self, now: Instant) -> HostTime {
        HostTime::from_ns(now.duration_since(self.start).as_nanos() as u64)
    }
}

fn firmware_key(text: &str) -> Result<Key, String> {
    key_from_hex(text).map_err(|_| "expected 64 hexadecimal digits".to_owned())
}

/// Returns the settings at startup: those in flash, overridden by those of the command line.
fn boot_settings(store: &mut Store<FileFlash>, overrides: &[(String, String)]) -> Result<Settings> {
    let mut settings = store.load().unwrap_or_default();
    for (name, value) in overrides {
        if let Err(refused) = settings.set(name, value) {
            bail!(
                "bridge: {name}={value} was rejected: {refused:?}; docs/guides/flash-bridge.md lists the settings"
            );
        }
    }
    Ok(settings)
}

fn chip() -> Result<Chip> {
    let mut random = [0; 16];
    std::fs::File::open("/dev/urandom")
        .and_then(|mut file| file.read_exact(&mut random))
        .context("bridge: no random numbers from /dev/urandom")?;
    Ok(Chip { address: [2, 0, 0, random[0], random[1], random[2]], random })
}

/// Default address of a bridge in AP mode.
pub(crate) const DEFAULT_BRIDGE: SocketAddrV4 =
    SocketAddrV4::new(Ipv4Addr::new(192, 168, 4, 1), 14550);
