//! MAVLink links over UDP, TCP or a serial line. Non-blocking; packets to an absent peer are dropped.

pub mod serial;

use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::{Duration, Instant};

use serial::{DEFAULT_BAUD, SerialPort, baud_rate};

/// Endpoint of MAVLink.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Endpoint {
    /// Sends to an address from an own port, like an autopilot's Wi-Fi bridge.
    UdpOut(SocketAddr),
    /// Waits for datagrams and answers their senders.
    UdpIn(SocketAddr),
    /// Waits for one TCP client at a time.
    TcpIn(SocketAddr),
    /// Connects to a TCP server, and reconnects if it closes.
    TcpOut(SocketAddr),
    /// Opens a serial device at a baud rate.
    Serial(PathBuf, u32),
    /// Creates a pseudo-terminal with this name and the speed of this baud rate.
    Pty(PathBuf, u32),
}

/// Text that is not a valid endpoint.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "mavlink endpoint '{0}': write udpout:HOST:PORT, udpin:HOST:PORT, tcpin:HOST:PORT, \
     tcpout:HOST:PORT, serial:PATH[:BAUD] or pty:PATH[:BAUD]"
)]
pub struct InvalidEndpoint(String);

impl FromStr for Endpoint {
    type Err = InvalidEndpoint;

    fn from_str(text: &str) -> Result<Self, InvalidEndpoint> {
        let invalid = || InvalidEndpoint(text.to_owned());
        let (kind, rest) = text.split_once(':').ok_or_else(invalid)?;
        let address = || resolve(rest).ok_or_else(invalid);
        let line = || {
            let (path, baud) = match rest.rsplit_once(':') {
                Some((path, baud)) => (path, baud.parse().map_err(|_| invalid())?),
                None => (rest, DEFAULT_BAUD),
            };
            let known = !path.is_empty() && baud_rate(baud).is_some();
            known.then(|| (PathBuf::from(path), baud)).ok_or_else(invalid)
        };
        Ok(match kind {
            "udpout" => Self::UdpOut(address()?),
            "udpin" => Self::UdpIn(address()?),
            "tcpin" => Self::TcpIn(address()?),
            "tcpout" => Self::TcpOut(address()?),
            "serial" => line().map(|(path, baud)| Self::Serial(path, baud))?,
            "pty" => line().map(|(path, baud)| Self::Pty(path, baud))?,
            _ => return Err(invalid()),
        })
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpOut(address) => write!(f, "udpout:{address}"),
            Self::UdpIn(address) => write!(f, "udpin:{address}"),
            Self::TcpIn(address) => write!(f, "tcpin:{address}"),
            Self::TcpOut(address) => write!(f, "tcpout:{address}"),
            Self::Serial(path, baud) => write!(f, "serial:{}:{baud}", path.display()),
            Self::Pty(path, baud) => write!(f, "pty:{}:{baud}", path.display()),
        }
    }
}

/// Returns the first address of `HOST:PORT`.
pub fn resolve(text: &str) -> Option<SocketAddr> {
    text.to_socket_addrs().ok()?.next()
}

/// Silence after which a peer of a `udpin` link is removed.
const PEER_SILENCE: Duration = Duration::from_secs(10);
/// Maximum number of peers.
const MAX_PEERS: usize = 8;
/// Maximum backlog of a TCP client [bytes]; beyond it, the client is disconnected.
const MAX_BACKLOG: usize = 256 * 1024;

/// Retry interval of a TCP server that does not answer.
const RETRY: Duration = Duration::from_millis(500);
/// Timeout of a TCP connection; short, because the simulation waits.
const CONNECT_PATIENCE: Duration = Duration::from_millis(20);

/// Side of a TCP connection.
pub enum TcpSide {
    /// Accepts clients on this socket.
    Listens(TcpListener),
    /// Connects to this address, next at this time.
    Connects(SocketAddr, Instant),
}

/// Open link.
pub enum Link {
    Udp {
        socket: UdpSocket,
        /// Fixed peer of `udpout`.
        target: Option<SocketAddr>,
        /// Recently active peers.
        peers: Vec<(SocketAddr, Instant)>,
    },
    Tcp {
        /// Whether it accepts or connects.
        side: TcpSide,
        /// Connected peer, and the bytes it has not accepted yet.
        client: Option<(TcpStream, Vec<u8>)>,
    },
    Serial(SerialPort),
}

impl Link {
    /// Opens a link.
    ///
    /// # Errors
    /// Returns the error of the operating system, usually a port in use.
    pub fn open(endpoint: &Endpoint) -> io::Result<Self> {
        Ok(match *endpoint {
            Endpoint::UdpOut(target) => {
                let any = if target.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
                Self::Udp { socket: bind_udp(any)?, target: Some(target), peers: Vec::new() }
            }
            Endpoint::UdpIn(address) => {
                Self::Udp { socket: bind_udp(address)?, target: None, peers: Vec::new() }
            }
            Endpoint::TcpIn(address) => {
                let listener = TcpListener::bind(address)?;
                listener.set_nonblocking(true)?;
                Self::Tcp { side: TcpSide::Listens(listener), client: None }
            }
            Endpoint::TcpOut(address) => {
                Self::Tcp { side: TcpSide::Connects(address, Instant::now()), client: None }
            }
            Endpoint::Serial(ref path, baud) => Self::Serial(SerialPort::open(path, baud)),
            Endpoint::Pty(ref path, baud) => Self::Serial(SerialPort::make(path, baud)?),
        })
    }

    /// Returns the local address; for `tcpout`, the remote one.
    ///
    /// # Errors
    /// Returns the error of the operating system.
    pub fn address(&self) -> io::Result<String> {
        Ok(match self {
            Self::Udp { socket, .. } => socket.local_addr()?.to_string(),
            Self::Tcp { side: TcpSide::Listens(listener), .. } => {
                listener.local_addr()?.to_string()
            }
            Self::Tcp { side: TcpSide::Connects(address, _), .. } => address.to_string(),
            Self::Serial(port) => port.path().display().to_string(),
        })
    }

    /// Passes all received data to `sink`, at most 64 pieces, so that a flood cannot stop the simulation.
    pub fn receive(&mut self, mut sink: impl FnMut(&[u8])) {
        let mut buffer = [0; 2048];
        match self {
            Self::Udp { socket, target, peers } => {
                for _ in 0..64 {
                    match socket.recv_from(&mut buffer) {
                        Ok((length, sender)) => {
                            if target.is_none() {
                                touch_peer(peers, sender);
                            }
                            sink(&buffer[..length]);
                        }
                        Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                        // A peer that does not exist yet causes an error: ignore it.
                        Err(_) => {}
                    }
                }
            }
            Self::Serial(port) => port.receive(sink),
            Self::Tcp { side, client } => {
                if let Some(stream) = side.next_peer(client.is_some())
                    && client.is_none()
                    && stream.set_nonblocking(true).is_ok()
                {
                    // Small packets must not wait for each other. If this fails, they wait.
                    let _ = stream.set_nodelay(true);
                    *client = Some((stream, Vec::new()));
                }
                let mut gone = false;
                if let Some((stream, _)) = client {
                    for _ in 0..64 {
                        match stream.read(&mut buffer) {
                            Ok(0) => {
                                gone = true;
                                break;
                            }
                            Ok(length) => sink(&buffer[..length]),
                            Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                            Err(error) if error.kind() == ErrorKind::Interrupted => {}
                            Err(_) => {
                                gone = true;
                                break;
                            }
                        }
                    }
                }
                if gone {
                    *client = None;
                }
            }
        }
    }

    /// Sends one packet to all peers.
    pub fn send(&mut self, packet: &[u8]) {
        match self {
            Self::Udp { socket, target, peers } => {
                peers.retain(|(_, received_at)| received_at.elapsed() < PEER_SILENCE);
                for address in target.iter().chain(peers.iter().map(|(address, _)| address)) {
                    // Without a receiver, the datagram is lost.
                    let _ = socket.send_to(packet, address);
                }
            }
            Self::Serial(port) => port.send(packet),
            Self::Tcp { client, .. } => {
                let Some((stream, backlog)) = client else { return };
                backlog.extend_from_slice(packet);
                let mut sent = 0;
                let gone = loop {
                    match stream.write(&backlog[sent..]) {
                        Ok(0) => break true,
                        Ok(length) => {
                            sent += length;
                            if sent == backlog.len() {
                                break false;
                            }
                        }
                        Err(error) if error.kind() == ErrorKind::WouldBlock => break false,
                        Err(error) if error.kind() == ErrorKind::Interrupted => {}
                        Err(_) => break true,
                    }
                };
                backlog.drain(..sent);
                if gone || backlog.len() > MAX_BACKLOG {
                    *client = None;
                }
            }
        }
    }
}

impl TcpSide {
    /// Returns a new peer, if there is one. `busy` means that a peer is already connected.
    fn next_peer(&mut self, busy: bool) -> Option<TcpStream> {
        match self {
            // Accepts also while busy, to disconnect a second client at once instead of letting it wait.
            Self::Listens(listener) => listener.accept().ok().map(|(stream, _)| stream),
            Self::Connects(address, due) => {
                if busy || Instant::now() < *due {
                    return None;
                }
                let stream = TcpStream::connect_timeout(address, CONNECT_PATIENCE).ok();
                *due = Instant::now() + RETRY;
                stream
            }
        }
    }
}

/// Binds a non-blocking UDP socket.
///
/// # Errors
/// Returns the error of the operating system.
pub fn bind_udp(address: impl ToSocketAddrs) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

fn touch_peer(peers: &mut Vec<(SocketAddr, Instant)>, sender: SocketAddr) {
    let now = Instant::now();
    if let Some(peer) = peers.iter_mut().find(|(address, _)| *address == sender) {
        peer.1 = now;
    } else if peers.len() < MAX_PEERS {
        peers.push((sender, now));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_parse_and_print() {
        for text in [
            "udpout:127.0.0.1:14550",
            "udpin:0.0.0.0:14550",
            "tcpin:127.0.0.1:5760",
            "tcpout:127.0.0.1:5760",
            "serial:/dev/ttyUSB0:57600",
            "pty:/tmp/uart:921600",
        ] {
            assert_eq!(text.parse::<Endpoint>().unwrap().to_string(), text);
        }
        assert_eq!("serial:/dev/ttyS1".parse(), Ok(Endpoint::Serial("/dev/ttyS1".into(), 921_600)));
        for text in [
            "",
            "udp:1.2.3.4:5",
            "udpout",
            "udpout:127.0.0.1",
            "tcpin:127.0.0.1:99999",
            "serial:",
            "serial:/dev/ttyS1:1234",
            "pty::57600",
        ] {
            let error = text.parse::<Endpoint>().unwrap_err();
            assert!(error.to_string().contains("udpout:HOST:PORT"), "{text}");
        }
    }

    #[test]
    fn tcp_works_in_both_directions_and_reconnects() {
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        let mut server = Link::open(&Endpoint::TcpIn(any)).unwrap();
        let address = server.address().unwrap().parse().unwrap();
        let mut client = Link::open(&Endpoint::TcpOut(address)).unwrap();
        let end = Instant::now() + Duration::from_secs(30);
        for round in 0..2u8 {
            let (mut there, mut back) = (Vec::new(), Vec::new());
            while !there.contains(&round) || !back.contains(&round) {
                assert!(Instant::now() < end, "round {round}: {there:?} {back:?}");
                client.receive(|bytes| back.extend_from_slice(bytes));
                server.receive(|bytes| there.extend_from_slice(bytes));
                client.send(&[round]);
                server.send(&[round]);
            }
            if let Link::Tcp { client, .. } = &mut client {
                *client = None;
            }
        }
    }
}
