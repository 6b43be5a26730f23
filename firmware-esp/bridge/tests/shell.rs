//! The shell of the chips on the host: two embassy-net stacks connected by a cable in memory, and a serial line in
//! memory.

use core::future::Future;
use core::net::{Ipv4Addr, SocketAddrV4};

use ed25519_dalek::{Signer, SigningKey};
use embassy_futures::join::{join, join3};
use embassy_futures::select::{Either, select};
use embassy_net::tcp::TcpSocket;
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_net::{Config, Ipv4Cidr, Stack, StackResources, StaticConfigV4};
use embassy_net_driver_channel as channel;
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::pipe::{Pipe, Reader, Writer};
use embassy_time::{Duration, with_timeout};
use embedded_io_async::Write;
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use sha2::{Digest, Sha256};
use vizflyt_bridge::mavlink_writer::write_packet;
use vizflyt_bridge::packet::{CutStats, Cutter, each_in_datagram};
use vizflyt_bridge::shell::{Buffers, Light, Platform, SOCKETS, Shared, run};
use vizflyt_bridge::stats::RestartCause;
use vizflyt_bridge::storage::Store;
use vizflyt_bridge::update::{Fault, Header, Slots, Target, Updater, Wanted};
use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::time::HostTime;

const MTU: usize = 1514;
const BRIDGE: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
const COMPANION: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 2);
/// Exceeded only by a hang.
const PATIENCE: Duration = Duration::from_secs(60);

/// A chip with flash in memory.
struct Bare {
    lights: Vec<Light>,
    halves: Halves,
    updater: Option<Updater>,
    restarts: u32,
    feeds: u32,
}

impl Platform for Bare {
    fn overruns(&mut self) -> u32 {
        7
    }

    fn restart_cause(&mut self) -> RestartCause {
        RestartCause::Watchdog
    }

    fn feed(&mut self) {
        self.feeds += 1;
    }

    fn restart(&mut self) {
        self.restarts += 1;
    }

    fn show(&mut self, light: Light) {
        self.lights.push(light);
    }

    fn signal_dbm(&mut self) -> Option<i8> {
        Some(-50)
    }

    fn update(&mut self, first: bool, bytes: &[u8]) -> Result<bool, &'static str> {
        if first {
            self.updater = None;
        }
        let updater = self.updater.get_or_insert_with(|| Updater::new(wanted()));
        updater.feed(&mut self.halves, bytes).map_err(Fault::message)
    }
}

struct Halves {
    spare: Ram,
    starts_spare: bool,
}

impl Slots for Halves {
    type Spare = Ram;

    fn spare(&mut self) -> &mut Ram {
        &mut self.spare
    }

    fn start_spare(&mut self) -> bool {
        self.starts_spare = true;
        true
    }
}

const FIRMWARE_SECRET: [u8; 32] = [9; 32];

fn wanted() -> Wanted {
    let key = SigningKey::from_bytes(&FIRMWARE_SECRET).verifying_key().to_bytes();
    Wanted { target: Target::Host, build: 3, key }
}

/// Flash in memory: erased bytes are ones, writes clear bits.
struct Ram(Vec<u8>);

impl ErrorType for Ram {
    type Error = NorFlashErrorKind;
}

impl Ram {
    fn place(&mut self, from: u32, len: usize) -> Result<&mut [u8], NorFlashErrorKind> {
        let from = from as usize;
        self.0.get_mut(from..from + len).ok_or(NorFlashErrorKind::OutOfBounds)
    }
}

impl ReadNorFlash for Ram {
    const READ_SIZE: usize = 4;

    fn read(&mut self, from: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        bytes.copy_from_slice(self.place(from, bytes.len())?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl NorFlash for Ram {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        self.place(from, (to - from) as usize)?.fill(0xFF);
        Ok(())
    }

    fn write(&mut self, from: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        for (cell, byte) in self.place(from, bytes.len())?.iter_mut().zip(bytes) {
            *cell &= byte;
        }
        Ok(())
    }
}

type Line = Pipe<NoopRawMutex, 1024>;
type LineIn<'a> = Reader<'a, NoopRawMutex, 1024>;
type LineOut<'a> = Writer<'a, NoopRawMutex, 1024>;

/// Carries frames from one end of the cable to the other.
async fn cable(mut from: channel::TxRunner<'_, MTU>, mut to: channel::RxRunner<'_, MTU>) {
    loop {
        let frame = from.tx_buf().await;
        let place = to.rx_buf().await;
        let len = frame.len();
        place[..len].copy_from_slice(frame);
        from.tx_done();
        to.rx_done(len);
    }
}

fn fixed(address: Ipv4Addr) -> Config {
    Config::ipv4_static(StaticConfigV4 {
        address: Ipv4Cidr::new(address, 24),
        gateway: None,
        dns_servers: heapless::Vec::default(),
    })
}

/// Runs `test` as companion and autopilot of a bridge. Returns the final state of the chip.
fn with_bridge<F>(test: impl FnOnce(Stack<'static>, LineIn<'static>, LineOut<'static>) -> F) -> Bare
where
    F: Future<Output = ()>,
{
    // Why leaked: embassy's stacks need memory that outlives them, like a chip's static memory.
    let states = [(); 2].map(|()| Box::leak(Box::new(channel::State::<MTU, 4, 4>::new())));
    let [state_a, state_b] = states;
    let hardware = |last| channel::driver::HardwareAddress::Ethernet([2, 0, 0, 0, 0, last]);
    let (runner_a, device_a) = channel::new(state_a, hardware(1));
    let (runner_b, device_b) = channel::new(state_b, hardware(2));
    let (link_a, in_a, out_a) = runner_a.split();
    let (link_b, in_b, out_b) = runner_b.split();
    link_a.set_link_state(channel::driver::LinkState::Up);
    link_b.set_link_state(channel::driver::LinkState::Up);
    let resources_a = Box::leak(Box::new(StackResources::<SOCKETS>::new()));
    let resources_b = Box::leak(Box::new(StackResources::<4>::new()));
    let (stack_a, mut net_a) = embassy_net::new(device_a, fixed(BRIDGE), resources_a, 1);
    let (stack_b, mut net_b) = embassy_net::new(device_b, fixed(COMPANION), resources_b, 2);

    let to_bridge = Box::leak(Box::new(Line::new()));
    let from_bridge = Box::leak(Box::new(Line::new()));
    let (bridge_in, autopilot_out) = to_bridge.split();
    let (autopilot_in, bridge_out) = from_bridge.split();
    // An absent client must not delay others.
    let absent = Some(SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 77), 14550));
    let settings = Settings { radio_status: false, client: absent, ..Settings::default() };
    let shared = Shared::new(Bridge::new(HostTime::ZERO, settings, Chip::default()));
    let mut buffers = Box::new(Buffers::new());
    let mut store = Store::new(Ram(vec![0xFF; 8192]), 0);
    let halves = Halves { spare: Ram(vec![0; 5 * 4096]), starts_spare: false };
    let mut bare = Bare { lights: Vec::new(), halves, updater: None, restarts: 0, feeds: 0 };
    {
        let bridge =
            run(&shared, stack_a, (bridge_in, bridge_out), &mut store, &mut bare, &mut buffers);
        let wires = join(cable(out_a, in_b), cable(out_b, in_a));
        let world = join3(join(net_a.run(), net_b.run()), wires, bridge);
        let test = with_timeout(PATIENCE, test(stack_b, autopilot_in, autopilot_out));
        match embassy_futures::block_on(select(world, test)) {
            Either::First(_) => panic!("the bridge must not end"),
            Either::Second(done) => done.expect("timeout"),
        }
    }
    bare
}

/// Returns a packet of message `id` that contains `number`.
fn packet(from: (u8, u8), id: u32, number: u32) -> Vec<u8> {
    let mut payload = [0x5A; 28];
    payload[..4].copy_from_slice(&number.to_le_bytes());
    let mut out = [0; 280];
    let len = write_packet(&mut out, from, number as u8, id, &payload);
    out[..len].to_vec()
}

const ATTITUDE: u32 = 30;
const VISION: u32 = 102;
const STATUSTEXT: u32 = 253;
const COUNT: u32 = 1000;

#[test]
fn carries_a_thousand_packets_each_way_without_loss() {
    let chip = with_bridge(|stack, uart_in, mut uart_out| async move {
        let (mut rx_meta, mut tx_meta) = ([PacketMetadata::EMPTY; 16], [PacketMetadata::EMPTY; 16]);
        let (mut rx, mut tx) = ([0; 8192], [0; 8192]);
        let mut socket = UdpSocket::new(stack, &mut rx_meta, &mut rx, &mut tx_meta, &mut tx);
        socket.bind(14550).unwrap();
        let up = async {
            let (mut cutter, mut bytes, mut came) = (Cutter::default(), [0; 256], 0);
            for number in 0..COUNT {
                socket.send_to(&packet((255, 191), VISION, number), (BRIDGE, 14550)).await.unwrap();
                while came <= number {
                    let len = uart_in.read(&mut bytes).await;
                    cutter.push(&bytes[..len], |found| {
                        if found.id() == VISION {
                            assert_eq!(found.bytes(), packet((255, 191), VISION, came));
                            came += 1;
                        }
                    });
                }
            }
        };
        up.await;
        let sender = async {
            for number in 0..COUNT {
                uart_out.write_all(&packet((1, 1), ATTITUDE, number)).await.unwrap();
                if number % 40 == 39 {
                    // Do not exceed the capacity of the ring.
                    embassy_time::Timer::after(Duration::from_millis(8)).await;
                }
            }
        };
        let receiver = async {
            let (mut came, mut bytes) = (0, [0; 1500]);
            while came < COUNT {
                let (len, _) = socket.recv_from(&mut bytes).await.unwrap();
                let mut cut = CutStats::default();
                each_in_datagram(&bytes[..len], &mut cut, |found| {
                    if found.id() == ATTITUDE {
                        assert_eq!(found.bytes(), packet((1, 1), ATTITUDE, came));
                        came += 1;
                    }
                });
                assert_eq!(cut.dropped_bytes, 0);
            }
        };
        join(sender, receiver).await;
    });
    assert!(chip.lights.contains(&Light::NoAutopilot), "{:?}", chip.lights);
}

/// Requests a page like a browser.
async fn ask_page(stack: Stack<'static>, path: &str) -> String {
    let (mut rx, mut tx) = ([0; 4096], [0; 1024]);
    let mut socket = TcpSocket::new(stack, &mut rx, &mut tx);
    // Refused while the page serves the previous connection; a browser would also retry.
    while socket.connect((BRIDGE, 80)).await.is_err() {
        embassy_time::Timer::after(Duration::from_millis(1)).await;
    }
    let request = format!("GET {path} HTTP/1.1\r\nHost: bridge\r\n\r\n");
    socket.write_all(request.as_bytes()).await.unwrap();
    let (mut answer, mut bytes) = (Vec::new(), [0; 512]);
    while let Ok(len @ 1..) = socket.read(&mut bytes).await {
        answer.extend_from_slice(&bytes[..len]);
    }
    String::from_utf8(answer).unwrap()
}

#[test]
fn serves_counters_to_a_browser() {
    with_bridge(|stack, _uart_in, _uart_out| async move {
        for _ in 0..2 {
            let answer = ask_page(stack, "/stats.json").await;
            assert!(answer.starts_with("HTTP/1.0 200 OK") && answer.ends_with("}\n"), "{answer}");
        }
    });
}

#[test]
fn tcp_carries_packets_of_successive_clients() {
    with_bridge(|stack, uart_in, mut uart_out| async move {
        for _ in 0..3 {
            let (mut rx, mut tx) = ([0; 4096], [0; 4096]);
            let mut socket = TcpSocket::new(stack, &mut rx, &mut tx);
            socket.connect((BRIDGE, 5760)).await.unwrap();
            let (mut up, mut down) = (Cutter::default(), Cutter::default());
            let mut bytes = [0; 512];
            for number in 0..50 {
                let mut sent = &packet((255, 191), VISION, number)[..];
                while !sent.is_empty() {
                    let len = socket.write(sent).await.unwrap();
                    sent = &sent[len..];
                }
                let mut received = false;
                while !received {
                    let len = uart_in.read(&mut bytes).await;
                    up.push(&bytes[..len], |found| {
                        received |= found.bytes() == packet((255, 191), VISION, number);
                    });
                }
                uart_out.write_all(&packet((1, 1), ATTITUDE, number)).await.unwrap();
                let mut received = false;
                while !received {
                    let len = socket.read(&mut bytes).await.unwrap();
                    down.push(&bytes[..len], |found| {
                        received |= found.bytes() == packet((1, 1), ATTITUDE, number);
                    });
                }
            }
            socket.abort();
            let _ = socket.flush().await;
        }
    });
}

/// Signs a firmware like `vizflyt bridge firmware sign`.
fn signed(body: &[u8]) -> Vec<u8> {
    let header = Header {
        target: Target::Host as u8,
        build: 3,
        len: body.len() as u32,
        hash: Sha256::digest(body).into(),
    };
    let key = SigningKey::from_bytes(&FIRMWARE_SECRET);
    [&header.sign(|message| key.sign(message).to_bytes())[..], body].concat()
}

/// Uploads a firmware and returns the answer.
async fn bring(stack: Stack<'static>, firmware: &[u8]) -> String {
    let (mut rx, mut tx) = ([0; 1024], [0; 1024]);
    let mut socket = TcpSocket::new(stack, &mut rx, &mut tx);
    while socket.connect((BRIDGE, 80)).await.is_err() {
        embassy_time::Timer::after(Duration::from_millis(1)).await;
    }
    let mut request = b"POST /update HTTP/1.0\r\n\r\n".to_vec();
    request.extend_from_slice(firmware);
    // A rejection may arrive before the last byte is sent.
    let _ = socket.write_all(&request).await;
    socket.close();
    let (mut answer, mut bytes) = (Vec::new(), [0; 512]);
    while let Ok(len @ 1..) = socket.read(&mut bytes).await {
        answer.extend_from_slice(&bytes[..len]);
    }
    String::from_utf8(answer).unwrap()
}

fn firmware() -> Vec<u8> {
    (0..9000_u32).map(|at| (at * 31 % 251) as u8).collect()
}

#[test]
fn installs_a_signed_firmware_over_the_network() {
    let chip = with_bridge(|stack, _uart_in, _uart_out| async move {
        let answer = bring(stack, &signed(&firmware())).await;
        assert!(answer.starts_with("HTTP/1.0 200 OK"), "{answer}");
        // Served only after the first upload is complete; a chip would be restarting.
        bring(stack, b"").await;
    });
    assert!(chip.halves.starts_spare && chip.restarts > 0);
    assert_eq!(&chip.halves.spare.0[..9000], &firmware()[..]);
}

#[test]
fn rejects_other_firmware_and_writes_nothing() {
    let chip = with_bridge(|stack, _uart_in, _uart_out| async move {
        let mut forged = signed(&firmware());
        forged[60] ^= 1;
        let answer = bring(stack, &forged).await;
        assert!(answer.starts_with("HTTP/1.0 409") && answer.contains("signature"), "{answer}");
        let answer = bring(stack, b"nothing").await;
        assert!(answer.contains("the connection ended before the firmware did"), "{answer}");
    });
    assert!(!chip.halves.starts_spare && chip.restarts == 0);
    assert!(chip.halves.spare.0.iter().all(|&byte| byte == 0), "erased");
}

#[test]
fn rejects_firmware_while_armed() {
    let chip = with_bridge(|stack, _uart_in, mut uart_out| async move {
        // Custom mode GUIDED, an ArduPilot quadrotor, armed, active, MAVLink 2.
        let payload = [4, 0, 0, 0, 2, 3, 0x80 | 0x09, 4, 3];
        let mut heartbeat = [0; 280];
        let len = write_packet(&mut heartbeat, (1, 1), 0, 0, &payload);
        uart_out.write_all(&heartbeat[..len]).await.unwrap();
        // Repeat until the bridge has processed the heartbeat.
        loop {
            let answer = bring(stack, &signed(&firmware())[..50]).await;
            if answer.contains("the vehicle is armed") {
                break;
            }
            embassy_time::Timer::after(Duration::from_millis(5)).await;
        }
    });
    assert!(!chip.halves.starts_spare);
}

#[test]
fn reports_chip_counters_and_feeds_the_watchdog() {
    let chip = with_bridge(|stack, _uart_in, _uart_out| async move {
        let (mut rx_meta, mut tx_meta) = ([PacketMetadata::EMPTY; 16], [PacketMetadata::EMPTY; 16]);
        let (mut rx, mut tx) = ([0; 8192], [0; 8192]);
        let mut socket = UdpSocket::new(stack, &mut rx_meta, &mut rx, &mut tx_meta, &mut tx);
        socket.bind(14550).unwrap();
        let (mut told, mut bytes) = (false, [0; 1500]);
        while !told {
            socket.send_to(&packet((255, 191), VISION, 0), (BRIDGE, 14550)).await.unwrap();
            let (len, _) = socket.recv_from(&mut bytes).await.unwrap();
            let mut cut = CutStats::default();
            each_in_datagram(&bytes[..len], &mut cut, |found| {
                let text = String::from_utf8_lossy(found.payload());
                told |= found.id() == STATUSTEXT && text.contains("its watchdog found it hung");
            });
        }
        let answer = ask_page(stack, "/stats.json").await;
        assert!(answer.contains("\"uart_overruns\":7,\"restart_cause\":4"), "{answer}");
    });
    assert!(chip.feeds > 0);
}
