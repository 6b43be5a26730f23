//! UDP socket of a pose stream: arrival stamps, and warnings of silence.

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::time::Duration;

use anyhow::{Context, Result};
use socket2::{Domain, Protocol, Socket, Type};
use vizflyt_protocol::time::ServerTime;

use super::arrival::Arrivals;
use super::source::{Measurement, PoseSource, SourceCounters};
use crate::clock;
use crate::poses::settings::Driver;

/// Parser of a pose stream: bytes in, poses out. Sans-IO.
pub trait PoseStream: Send {
    /// Processes one datagram of `from` that arrived at `now`. Returns the contained poses of the configured
    /// vehicles that are newer than the last, at most one per vehicle.
    fn handle_packet_from(
        &mut self,
        now: ServerTime,
        from: SocketAddr,
        bytes: &[u8],
    ) -> &[Measurement];

    /// Like [`Self::handle_packet_from`], for a source with a single unnamed sender.
    fn handle_packet(&mut self, now: ServerTime, bytes: &[u8]) -> &[Measurement] {
        self.handle_packet_from(now, UNNAMED, bytes)
    }

    /// Returns the next datagram to send, with its destination. Called after each packet, and ten times a
    /// second.
    fn poll_transmit(&mut self, _now: ServerTime) -> Option<(SocketAddr, Vec<u8>)> {
        None
    }

    /// Returns the next warning for the user, once per occurrence.
    fn next_warning(&mut self) -> Option<String>;

    /// Returns the counters of a vehicle.
    fn counters(&self, vehicle: usize) -> SourceCounters;

    /// Returns the advice for a silent stream.
    fn silence(&self) -> Silence;
}

/// Advice for the user about a silent stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Silence {
    /// If no packet has ever arrived.
    pub at_first: &'static str,
    /// If the stream has stopped.
    pub later: &'static str,
}

/// Bound socket without a stream yet.
#[derive(Debug)]
pub struct UdpPort {
    driver: Driver,
    socket: UdpSocket,
    address: SocketAddr,
}

impl UdpPort {
    /// Binds `address`.
    pub fn bind(driver: Driver, address: SocketAddr) -> Result<Self> {
        let open = || -> std::io::Result<UdpSocket> {
            let kind = Domain::for_address(address);
            let socket = Socket::new(kind, Type::DGRAM, Some(Protocol::UDP))?;
            // Room for a second of a stream, so that a busy computer loses no frame.
            socket.set_recv_buffer_size(RECEIVE_BUFFER)?;
            socket.bind(&address.into())?;
            Ok(socket.into())
        };
        let port_0 = match driver {
            Driver::Vicon => "--vicon 127.0.0.1:0".to_owned(),
            other => format!("--pose {other}:127.0.0.1:0"),
        };
        let socket = open().with_context(|| {
            format!("{driver}: cannot listen on {address}; is another server running? try {port_0}")
        })?;
        let address = socket.local_addr()?;
        Ok(Self { driver, socket, address })
    }

    /// Joins a multicast group on this computer's address `interface`, or by the system's routes. Other
    /// programs on this computer may listen too.
    pub fn join(driver: Driver, group: Ipv4Addr, port: u16, interface: Ipv4Addr) -> Result<Self> {
        let open = || -> std::io::Result<UdpSocket> {
            let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
            socket.set_recv_buffer_size(RECEIVE_BUFFER)?;
            socket.set_reuse_address(true)?;
            socket.bind(&SocketAddr::from((Ipv4Addr::UNSPECIFIED, port)).into())?;
            let socket: UdpSocket = socket.into();
            socket.join_multicast_v4(&group, &interface)?;
            Ok(socket)
        };
        let socket = open().with_context(|| {
            format!(
                "{driver}: cannot join the multicast group {group}:{port} on {interface}; set \
                 `interface` to this computer's address in the motion capture's network"
            )
        })?;
        let address = (IpAddr::V4(group), socket.local_addr()?.port()).into();
        Ok(Self { driver, socket, address })
    }

    /// Returns the address to which the stream must be sent.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Connects the socket to a stream's parser. Packets that came before are dropped: the kernel has not
    /// stamped their arrival, so a sender that runs before the server would look like one whose clock jumps.
    pub fn with<S: PoseStream>(self, stream: S) -> UdpPoses<S> {
        let arrivals = Arrivals::of(&self.socket);
        if self.socket.set_nonblocking(true).is_ok() {
            while self.socket.recv(&mut [0]).is_ok() {}
            let _ = self.socket.set_nonblocking(false);
        }
        UdpPoses {
            arrivals,
            port: self,
            from: None,
            stream,
            buffer: vec![0; 65536].into_boxed_slice(),
            received_at: clock::now(),
            silence_warned: false,
            warnings: VecDeque::new(),
        }
    }
}

/// Receiver of a pose stream.
#[derive(Debug)]
pub struct UdpPoses<S> {
    port: UdpPort,
    arrivals: Arrivals,
    from: Option<SocketAddr>,
    stream: S,
    buffer: Box<[u8]>,
    /// Time of the last arrival; initially the start.
    received_at: ServerTime,
    silence_warned: bool,
    warnings: VecDeque<String>,
}

impl<S: PoseStream> UdpPoses<S> {
    fn send(&mut self, now: ServerTime) {
        while let Some((to, bytes)) = self.stream.poll_transmit(now) {
            // A lost request is repeated.
            let _ = self.port.socket.send_to(&bytes, to);
        }
    }

    fn notice_silence(&mut self, now: ServerTime) {
        let silence_s = now.seconds_since(self.received_at);
        let allowed_s = if self.from.is_some() { SILENCE_S } else { FIRST_SILENCE_S };
        if self.silence_warned || !(silence_s > allowed_s) {
            return;
        }
        self.silence_warned = true;
        let (driver, ms) = (self.port.driver, (silence_s * 1e3).round());
        let Silence { at_first, later } = self.stream.silence();
        self.warnings.push_back(match self.from {
            Some(from) => format!("{driver}: no sample for {ms} ms from {from}; {later}"),
            None => {
                format!(
                    "{driver}: nothing has come to {} for {ms} ms; {at_first}",
                    self.port.address
                )
            }
        });
    }
}

impl<S: PoseStream> PoseSource for UdpPoses<S> {
    fn receive(&mut self, timeout: Duration) -> &[Measurement] {
        // A timeout of zero would mean no timeout for the socket.
        let timeout = timeout.max(Duration::from_millis(1));
        if self.port.socket.set_read_timeout(Some(timeout)).is_err() {
            return &[];
        }
        self.send(clock::now());
        // Errors are the timeout or an ICMP error: both mean no pose.
        let Ok(arrival) = self.arrivals.receive(&self.port.socket, &mut self.buffer) else {
            self.notice_silence(clock::now());
            return &[];
        };
        self.received_at = arrival.at;
        self.from = Some(arrival.from);
        self.silence_warned = false;
        self.stream.handle_packet_from(arrival.at, arrival.from, &self.buffer[..arrival.length])
    }

    fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front().or_else(|| self.stream.next_warning())
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        self.stream.counters(vehicle)
    }
}

/// Address of an unnamed sender.
pub(super) const UNNAMED: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0);
/// 1 MiB holds 3 s of 1024-byte packets at 300 Hz.
const RECEIVE_BUFFER: usize = 1 << 20;
/// Silence before a warning: a hundred frames at 200 Hz. [s]
const SILENCE_S: f64 = 0.5;
/// Silence before the first packet: the simulator, or a user at Tracker, needs time to start. [s]
const FIRST_SILENCE_S: f64 = 5.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::poses::drivers::json::JsonStream;
    use crate::poses::drivers::vicon::ViconStream;
    use crate::poses::settings::LocalizationConfig;

    #[test]
    fn drops_packets_that_came_before_the_stream_was_read() {
        let port = UdpPort::bind(Driver::Json, "127.0.0.1:0".parse().unwrap()).unwrap();
        let to = port.address();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let send = |x_m: u64| {
            let packet = format!(
                "{{\"vizflyt_pose\": 1, \"object\": \"v\", \"stamp_ns\": {}, \
                 \"position_m\": [{x_m}, 0, 0], \"rotation_xyzw\": [0, 0, 0, 1]}}",
                x_m * 20_000_000
            );
            sender.send_to(packet.as_bytes(), to).unwrap();
        };
        (1..50).for_each(send);
        let config = LocalizationConfig::new(Driver::Json);
        let mut source = port.with(JsonStream::new(&config, 0, &["v"]));
        send(50);
        let pose = source.receive(Duration::from_secs(30))[0];
        assert_eq!(pose.world_from_body.translation_m.x, 50.0);
        assert_eq!(source.next_warning(), None);
    }

    #[test]
    fn reads_a_real_socket_and_warns_when_the_stream_ends() {
        let port = UdpPort::bind(Driver::Vicon, "127.0.0.1:0".parse().unwrap()).unwrap();
        let to = port.address();
        let config = LocalizationConfig::new(Driver::Vicon);
        let mut source = port.with(ViconStream::new(&config, 0, &["v"]));
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut bytes = vec![1, 0, 0, 0, 1, 0, 72, 0];
        bytes.extend_from_slice(b"v");
        bytes.resize(8 + 24, 0);
        for value in [1000.0f64, 0.0, 0.0, 0.0, 0.0, 0.0] {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        sender.send_to(&bytes, to).unwrap();
        let pose = source.receive(Duration::from_secs(30))[0];
        assert_eq!(pose.world_from_body.translation_m.x, 1.0);
        assert_eq!(source.next_warning(), None);
        // Simulates that the last packet came a second ago.
        source.notice_silence(pose.arrival.plus_seconds(1.0));
        let from = sender.local_addr().unwrap();
        assert_eq!(
            source.next_warning().unwrap(),
            format!("vicon: no sample for 1000 ms from {from}; set Tracker to Live, then retry")
        );
        source.notice_silence(pose.arrival.plus_seconds(2.0));
        assert_eq!(source.next_warning(), None, "reported once");
    }
}
