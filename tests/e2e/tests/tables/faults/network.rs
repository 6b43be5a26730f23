//! A network in memory: both directions of a path, impaired as configured by a seeded random generator.

use std::collections::{HashMap, VecDeque};
use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::ops::Range;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use quinn::udp::{EcnCodepoint, RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use tokio::time::Instant;

use vizflyt_protocol::random::SplitMix64;

use super::world::{World, lock};

/// Impairment of one direction.
#[derive(Clone, Debug)]
pub(crate) struct Impairment {
    /// End-to-end delay.
    pub(crate) delay: Duration,
    /// Maximum random additional delay; packets keep their order.
    pub(crate) jitter: Duration,
    /// Fraction of lost packets, independent of each other.
    pub(crate) loss: f64,
    /// Fraction of duplicated packets.
    pub(crate) duplicate: f64,
    /// Fraction of packets delayed by [`HELD_BACK`], so that later ones overtake them.
    pub(crate) reorder: f64,
    /// Bandwidth. [bit/s]
    pub(crate) bandwidth_bps: u64,
    /// Maximum queue at the bottleneck; further packets are lost. [bytes]
    pub(crate) queue: usize,
    /// Maximum size of an IP packet; larger ones are lost without a reply. [bytes]
    pub(crate) mtu: usize,
    /// Time ranges without any delivery, since the start.
    pub(crate) blackouts: Vec<Range<Duration>>,
}

impl Default for Impairment {
    /// Returns a gigabit cable with one switch.
    fn default() -> Self {
        Self {
            delay: Duration::from_micros(100),
            jitter: Duration::ZERO,
            loss: 0.0,
            duplicate: 0.0,
            reorder: 0.0,
            bandwidth_bps: 1_000_000_000,
            queue: 1 << 20,
            mtu: 1500,
            blackouts: Vec::new(),
        }
    }
}

/// Delay of a reordered packet.
pub(crate) const HELD_BACK: Duration = Duration::from_millis(2);
/// Interval in which network cards collect packets before they interrupt the processor.
const GATHER: Duration = Duration::from_micros(20);
/// Size of IPv4 and UDP headers. [bytes]
const HEADERS: usize = 28;

/// One direction.
struct Direction {
    does: Impairment,
    random: SplitMix64,
    /// Time at which the bottleneck has sent everything.
    busy: Instant,
    /// Arrival of the newest packet that was not reordered.
    newest: Instant,
}

impl Direction {
    /// Returns the arrival times of a packet of `len` bytes: none, one or two.
    fn arrivals(&mut self, start: Instant, now: Instant, len: usize) -> [Option<Instant>; 2] {
        let (does, random) = (&self.does, &mut self.random);
        // A constant number of draws, so that one setting does not change the effect of another.
        let [lost, twice, late, jitter] = [(); 4].map(|()| random.unit());
        let len = len + HEADERS;
        let dark = does.blackouts.iter().any(|range| range.contains(&(now - start)));
        let waiting = self.busy.saturating_duration_since(now);
        let queued = waiting.as_secs_f64() * does.bandwidth_bps as f64 / 8.0;
        if len > does.mtu || dark || lost < does.loss || queued + len as f64 > does.queue as f64 {
            return [None; 2];
        }
        let wire = Duration::from_secs_f64(8.0 * len as f64 / does.bandwidth_bps as f64);
        self.busy = self.busy.max(now) + wire;
        let mut at = self.busy + does.delay + does.jitter.mul_f64(jitter);
        if late < does.reorder {
            at += HELD_BACK;
        } else {
            at = at.max(self.newest);
            self.newest = at;
        }
        let gather = GATHER.as_nanos() as u64;
        let since = ((at - start).as_nanos() as u64).next_multiple_of(gather);
        let at = start + Duration::from_nanos(since);
        [Some(at), (twice < does.duplicate).then_some(at + GATHER)]
    }
}

/// The path between one server and its runtimes.
pub(crate) struct Network {
    world: Arc<World>,
    start: Instant,
    server: SocketAddr,
    inboxes: Mutex<HashMap<SocketAddr, Arc<Inbox>>>,
    down: Mutex<Direction>,
    up: Mutex<Direction>,
}

impl Network {
    /// Creates a network with a server at this address.
    pub(crate) fn new(
        world: Arc<World>,
        seed: u64,
        server: SocketAddr,
        down: Impairment,
        up: Impairment,
    ) -> Arc<Self> {
        let start = Instant::now();
        let direction = |does, seed| {
            Mutex::new(Direction {
                does,
                random: SplitMix64::new(seed),
                busy: start,
                newest: start,
            })
        };
        let (down, up) = (direction(down, 2 * seed), direction(up, 2 * seed + 1));
        Arc::new(Self { world, start, server, inboxes: Mutex::default(), down, up })
    }

    /// Returns a socket; another socket with the same address no longer receives anything.
    pub(crate) fn socket(self: &Arc<Self>, address: SocketAddr) -> Arc<Socket> {
        let inbox = Arc::new(Inbox::default());
        lock(&self.inboxes).insert(address, inbox.clone());
        Arc::new(Socket { network: self.clone(), address: Mutex::new(address), inbox })
    }

    fn carry(&self, from: SocketAddr, to: SocketAddr, ecn: Option<EcnCodepoint>, bytes: &[u8]) {
        let direction = if to == self.server { &self.up } else { &self.down };
        let arrivals = lock(direction).arrivals(self.start, Instant::now(), bytes.len());
        let Some(inbox) = lock(&self.inboxes).get(&to).cloned() else { return };
        for at in arrivals.into_iter().flatten() {
            let packet = Packet { from, ecn, bytes: bytes.to_vec() };
            let inbox = inbox.clone();
            self.world.plan(at, move || inbox.put(packet));
        }
    }
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Network").finish_non_exhaustive()
    }
}

struct Packet {
    from: SocketAddr,
    ecn: Option<EcnCodepoint>,
    bytes: Vec<u8>,
}

/// Packets that have arrived at a socket.
#[derive(Default)]
struct Inbox(Mutex<(VecDeque<Packet>, Option<Waker>)>);

impl Inbox {
    fn put(&self, packet: Packet) {
        let mut inbox = lock(&self.0);
        inbox.0.push_back(packet);
        if let Some(waker) = inbox.1.take() {
            waker.wake();
        }
    }
}

/// One end of the network.
pub(crate) struct Socket {
    network: Arc<Network>,
    address: Mutex<SocketAddr>,
    inbox: Arc<Inbox>,
}

impl Socket {
    /// Changes the address, as after a change of network or a rebound NAT. Packets in transit to the old address are
    /// lost.
    pub(crate) fn move_to(&self, address: SocketAddr) {
        let mut inboxes = lock(&self.network.inboxes);
        inboxes.remove(&std::mem::replace(&mut *lock(&self.address), address));
        inboxes.insert(address, self.inbox.clone());
    }

    /// Stops sending and receiving, as if the process were killed.
    pub(crate) fn kill(&self) {
        let mut inboxes = lock(&self.network.inboxes);
        let address = *lock(&self.address);
        if inboxes.get(&address).is_some_and(|inbox| Arc::ptr_eq(inbox, &self.inbox)) {
            inboxes.remove(&address);
        }
    }

    fn lives(&self) -> bool {
        let inboxes = lock(&self.network.inboxes);
        inboxes.values().any(|inbox| Arc::ptr_eq(inbox, &self.inbox))
    }
}

impl fmt::Debug for Socket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Socket").field(&*lock(&self.address)).finish()
    }
}

impl AsyncUdpSocket for Socket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Box::pin(Writable)
    }

    fn try_send(&self, transmit: &Transmit) -> io::Result<()> {
        if self.lives() {
            let from = *lock(&self.address);
            let segment = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
            for bytes in transmit.contents.chunks(segment) {
                self.network.carry(from, transmit.destination, transmit.ecn, bytes);
            }
        }
        Ok(())
    }

    fn poll_recv(
        &self,
        cx: &mut Context,
        buffers: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut inbox = lock(&self.inbox.0);
        let mut count = 0;
        for (buffer, meta) in buffers.iter_mut().zip(meta) {
            let Some(packet) = inbox.0.pop_front() else { break };
            let len = packet.bytes.len().min(buffer.len());
            buffer[..len].copy_from_slice(&packet.bytes[..len]);
            *meta = RecvMeta { addr: packet.from, len, stride: len, ecn: packet.ecn, dst_ip: None };
            count += 1;
        }
        if count == 0 {
            inbox.1 = Some(cx.waker().clone());
            return Poll::Pending;
        }
        Poll::Ready(Ok(count))
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(*lock(&self.address))
    }

    fn max_transmit_segments(&self) -> usize {
        10
    }

    fn may_fragment(&self) -> bool {
        false
    }
}

/// Always writable: the path drops excess packets.
#[derive(Debug)]
struct Writable;

impl UdpPoller for Writable {
    fn poll_writable(self: Pin<&mut Self>, _: &mut Context) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}
