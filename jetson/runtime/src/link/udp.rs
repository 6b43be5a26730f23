//! Drives a [`Link`](super::Link) over UDP: a socket that waits for the autopilot (`udpin`) or
//! speaks first (`udpout`).

use std::fmt;
use std::io;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::str::FromStr;
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

/// Where the autopilot is: `udpin:ADDR:PORT` or `udpout:ADDR:PORT`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MavlinkAddress {
    /// Binds, and answers whoever sends.
    UdpIn(SocketAddr),
    /// Sends there.
    UdpOut(SocketAddr),
}

impl FromStr for MavlinkAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!("{text:?} is no MAVLink address; write udpin:0.0.0.0:14550 or udpout:HOST:PORT")
        };
        let (kind, address) = text.split_once(':').ok_or_else(wrong)?;
        let resolve = || {
            let mut found =
                address.to_socket_addrs().map_err(|error| format!("{address}: {error}"))?;
            found.next().ok_or_else(|| format!("{address} has no address"))
        };
        match kind {
            "udpin" => Ok(Self::UdpIn(resolve()?)),
            "udpout" => Ok(Self::UdpOut(resolve()?)),
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for MavlinkAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpIn(address) => write!(f, "udpin:{address}"),
            Self::UdpOut(address) => write!(f, "udpout:{address}"),
        }
    }
}

/// A partner silent for this long may be replaced by another sender: a restarted bridge comes
/// from a new port. [s]
const PARTNER_KEPT: Duration = Duration::from_secs(3);

/// The socket, shared by a receiving thread and the control loop.
#[derive(Debug)]
pub struct UdpPort {
    socket: UdpSocket,
}

impl UdpPort {
    /// Opens the socket.
    pub fn open(address: MavlinkAddress) -> io::Result<Self> {
        let local = match address {
            MavlinkAddress::UdpIn(local) => local,
            MavlinkAddress::UdpOut(SocketAddr::V4(_)) => SocketAddr::from(([0, 0, 0, 0], 0)),
            MavlinkAddress::UdpOut(SocketAddr::V6(_)) => SocketAddr::from(([0_u16; 8], 0)),
        };
        let socket = Socket::new(Domain::for_address(local), Type::DGRAM, Some(Protocol::UDP))?;
        // A second of telemetry; best effort, as the kernel caps it.
        let _ = socket.set_recv_buffer_size(256 * 1024);
        socket.bind(&local.into())?;
        let socket = UdpSocket::from(socket);
        // So that a receiving thread sees the end of the flight.
        socket.set_read_timeout(Some(Duration::from_millis(100)))?;
        Ok(Self { socket })
    }

    /// Returns the address bound to.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Waits for a datagram, 100 ms at most; `None` if none came.
    pub fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<(usize, SocketAddr)>> {
        match self.socket.recv_from(buffer) {
            Ok(received) => Ok(Some(received)),
            Err(error) => match error.kind() {
                // ConnectionRefused: an earlier datagram of ours found nobody.
                io::ErrorKind::WouldBlock
                | io::ErrorKind::TimedOut
                | io::ErrorKind::Interrupted
                | io::ErrorKind::ConnectionRefused => Ok(None),
                _ => Err(error),
            },
        }
    }

    /// Sends a datagram; loss is the protocol's concern.
    pub fn send(&self, bytes: &[u8], to: SocketAddr) {
        let _ = self.socket.send_to(bytes, to);
    }
}

/// Whom to answer: the one given, or the one who speaks.
#[derive(Debug)]
pub struct Partner {
    fixed: bool,
    current: Option<(SocketAddr, Instant)>,
}

impl Partner {
    /// Makes the choice for an address.
    pub fn new(address: MavlinkAddress, now: Instant) -> Self {
        match address {
            MavlinkAddress::UdpIn(_) => Self { fixed: false, current: None },
            MavlinkAddress::UdpOut(to) => Self { fixed: true, current: Some((to, now)) },
        }
    }

    /// Takes note of a sender; returns whether to listen to it. A second sender is ignored while
    /// the first one speaks.
    pub fn heard(&mut self, from: SocketAddr, now: Instant) -> bool {
        match &mut self.current {
            Some((known, at)) if *known == from => {
                *at = now;
                true
            }
            Some((_, at)) if self.fixed || now.duration_since(*at) < PARTNER_KEPT => false,
            _ => {
                self.current = Some((from, now));
                true
            }
        }
    }

    /// Returns where to send.
    pub fn address(&self) -> Option<SocketAddr> {
        self.current.map(|(address, _)| address)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read() {
        let check = |text: &str, expected: Option<MavlinkAddress>| {
            assert_eq!(text.parse().ok(), expected, "{text}");
        };
        let address = SocketAddr::from(([127, 0, 0, 1], 14550));
        check("udpin:127.0.0.1:14550", Some(MavlinkAddress::UdpIn(address)));
        check("udpout:127.0.0.1:14550", Some(MavlinkAddress::UdpOut(address)));
        check("127.0.0.1:14550", None);
        check("serial:/dev/ttyUSB0", None);
        check("udpin:127.0.0.1", None);
    }

    #[test]
    fn a_second_sender_waits_until_the_first_is_silent() {
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        let a = SocketAddr::from(([127, 0, 0, 1], 1));
        let b = SocketAddr::from(([127, 0, 0, 1], 2));
        let mut partner = Partner::new("udpin:127.0.0.1:0".parse().unwrap(), start);
        assert_eq!(partner.address(), None);
        assert!(partner.heard(a, start));
        assert!(!partner.heard(b, start + second) && partner.address() == Some(a));
        assert!(partner.heard(a, start + second));
        assert!(!partner.heard(b, start + 3 * second));
        assert!(partner.heard(b, start + 4 * second) && partner.address() == Some(b));

        let mut fixed = Partner::new(MavlinkAddress::UdpOut(a), start);
        assert!(!fixed.heard(b, start + 9 * second) && fixed.address() == Some(a));
    }

    #[test]
    fn datagrams_go_both_ways() {
        let here = UdpPort::open("udpin:127.0.0.1:0".parse().unwrap()).unwrap();
        let address = here.local_addr().unwrap();
        let there = UdpPort::open(MavlinkAddress::UdpOut(address)).unwrap();
        there.send(b"ping", address);
        let mut buffer = [0; 16];
        // The kernel has queued it before `send` returned: loopback.
        let (len, from) = here.receive(&mut buffer).unwrap().unwrap();
        assert_eq!(&buffer[..len], b"ping");
        here.send(b"pong", from);
        let (len, _) = there.receive(&mut buffer).unwrap().unwrap();
        assert_eq!(&buffer[..len], b"pong");
    }
}
