//! The shell that chips run, on the host: two stacks of embassy-net joined by a cable in memory, and
//! a serial line in memory.

use core::future::Future;
use core::net::Ipv4Addr;

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
use vizflyt_bridge::packet::{CutStats, Cutter, each_in_datagram};
use vizflyt_bridge::seal::seal;
use vizflyt_bridge::shell::{Buffers, Light, Platform, SOCKETS, Shared, run};
use vizflyt_bridge::storage::Store;
use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::time::HostTime;

const MTU: usize = 1514;
const BRIDGE: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
const COMPANION: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 2);
/// Longer than this only a hang takes.
const PATIENCE: Duration = Duration::from_secs(60);

/// A chip without anything.
#[derive(Default)]
struct Bare {
    lights: Vec<Light>,
}

impl Platform for Bare {
    fn restart(&mut self) {}

    fn show(&mut self, light: Light) {
        self.lights.push(light);
    }

    fn signal_dbm(&mut self) -> Option<i8> {
        Some(-50)
    }
}

struct NoFlash;

impl ErrorType for NoFlash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for NoFlash {
    const READ_SIZE: usize = 4;

    fn read(&mut self, _: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        bytes.fill(0xFF);
        Ok(())
    }

    fn capacity(&self) -> usize {
        8192
    }
}

impl NorFlash for NoFlash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, _: u32, _: u32) -> Result<(), NorFlashErrorKind> {
        Ok(())
    }

    fn write(&mut self, _: u32, _: &[u8]) -> Result<(), NorFlashErrorKind> {
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

/// Runs `test` with a bridge's companion and autopilot; returns what the light showed.
fn with_bridge<F>(
    test: impl FnOnce(Stack<'static>, LineIn<'static>, LineOut<'static>) -> F,
) -> Vec<Light>
where
    F: Future<Output = ()>,
{
    // Why leaked: embassy's stacks want memory that outlives them, as a chip's static memory does.
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
    let settings = Settings { radio_status: false, ..Settings::default() };
    let shared = Shared::new(Bridge::new(HostTime::ZERO, settings, Chip::default()));
    let mut buffers = Box::new(Buffers::new());
    let (mut store, mut bare) = (Store::new(NoFlash, 0), Bare::default());
    {
        let bridge =
            run(&shared, stack_a, (bridge_in, bridge_out), &mut store, &mut bare, &mut buffers);
        let wires = join(cable(out_a, in_b), cable(out_b, in_a));
        let world = join3(join(net_a.run(), net_b.run()), wires, bridge);
        let test = with_timeout(PATIENCE, test(stack_b, autopilot_in, autopilot_out));
        match embassy_futures::block_on(select(world, test)) {
            Either::First(_) => panic!("the bridge runs for ever"),
            Either::Second(done) => done.expect("everything comes in time"),
        }
    }
    bare.lights
}

/// A whole packet of message `id`, told apart by `number`.
fn packet(from: (u8, u8), id: u32, number: u32) -> Vec<u8> {
    let mut payload = [0x5A; 28];
    payload[..4].copy_from_slice(&number.to_le_bytes());
    let mut out = [0; 280];
    let len = seal(&mut out, from, number as u8, id, &payload);
    out[..len].to_vec()
}

const ATTITUDE: u32 = 30;
const VISION: u32 = 102;
const COUNT: u32 = 1000;

#[test]
fn a_thousand_packets_each_way_over_udp_and_none_lost_or_changed() {
    let lights = with_bridge(|stack, uart_in, mut uart_out| async move {
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
        let say = async {
            for number in 0..COUNT {
                uart_out.write_all(&packet((1, 1), ATTITUDE, number)).await.unwrap();
                if number % 40 == 39 {
                    // As many as the ring holds may be under way.
                    embassy_time::Timer::after(Duration::from_millis(8)).await;
                }
            }
        };
        let hear = async {
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
        join(say, hear).await;
    });
    assert!(lights.contains(&Light::NoAutopilot), "{lights:?}");
}

#[test]
fn a_browser_sees_the_page() {
    with_bridge(|stack, _uart_in, _uart_out| async move {
        for _ in 0..2 {
            let (mut rx, mut tx) = ([0; 4096], [0; 1024]);
            let mut socket = TcpSocket::new(stack, &mut rx, &mut tx);
            // Refused while the page still serves the one before, as a browser would try again.
            while socket.connect((BRIDGE, 80)).await.is_err() {
                embassy_time::Timer::after(Duration::from_millis(1)).await;
            }
            socket.write_all(b"GET /stats.json HTTP/1.1\r\nHost: bridge\r\n\r\n").await.unwrap();
            let (mut answer, mut bytes) = (Vec::new(), [0; 512]);
            while let Ok(len @ 1..) = socket.read(&mut bytes).await {
                answer.extend_from_slice(&bytes[..len]);
            }
            let answer = String::from_utf8(answer).unwrap();
            assert!(answer.starts_with("HTTP/1.0 200 OK") && answer.ends_with("}\n"), "{answer}");
        }
    });
}

#[test]
fn tcp_carries_the_same_and_a_second_client_follows_the_first() {
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
                let mut heard = false;
                while !heard {
                    let len = uart_in.read(&mut bytes).await;
                    up.push(&bytes[..len], |found| {
                        heard |= found.bytes() == packet((255, 191), VISION, number);
                    });
                }
                uart_out.write_all(&packet((1, 1), ATTITUDE, number)).await.unwrap();
                let mut heard = false;
                while !heard {
                    let len = socket.read(&mut bytes).await.unwrap();
                    down.push(&bytes[..len], |found| {
                        heard |= found.bytes() == packet((1, 1), ATTITUDE, number);
                    });
                }
            }
            socket.abort();
            let _ = socket.flush().await;
        }
    });
}
