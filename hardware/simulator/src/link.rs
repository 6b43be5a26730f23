//! Sockets of the simulator: where MAVLink goes and comes from. Non-blocking; a peer that is not
//! there loses packets and nothing else.

use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs, UdpSocket};
use std::str::FromStr;
use std::time::{Duration, Instant};

/// How MAVLink is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endpoint {
    /// Send to an address from a port of our own, as an autopilot's Wi-Fi bridge does.
    UdpOut(SocketAddr),
    /// Wait for datagrams and answer their senders.
    UdpIn(SocketAddr),
    /// Wait for one TCP client at a time.
    TcpIn(SocketAddr),
}

/// An endpoint that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("mavlink endpoint '{0}': write udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT")]
pub struct InvalidEndpoint(String);

impl FromStr for Endpoint {
    type Err = InvalidEndpoint;

    fn from_str(text: &str) -> Result<Self, InvalidEndpoint> {
        let invalid = || InvalidEndpoint(text.to_owned());
        let (kind, address) = text.split_once(':').ok_or_else(invalid)?;
        let address = resolve(address).ok_or_else(invalid)?;
        match kind {
            "udpout" => Ok(Self::UdpOut(address)),
            "udpin" => Ok(Self::UdpIn(address)),
            "tcpin" => Ok(Self::TcpIn(address)),
            _ => Err(invalid()),
        }
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpOut(address) => write!(f, "udpout:{address}"),
            Self::UdpIn(address) => write!(f, "udpin:{address}"),
            Self::TcpIn(address) => write!(f, "tcpin:{address}"),
        }
    }
}

/// Returns the first address of `HOST:PORT`.
pub fn resolve(text: &str) -> Option<SocketAddr> {
    text.to_socket_addrs().ok()?.next()
}

/// A peer of a `udpin` link is forgotten after this silence.
const PEER_SILENCE: Duration = Duration::from_secs(10);
/// Peers answered at once at most.
const MAX_PEERS: usize = 8;
/// Bytes a TCP client may be behind before it is let go.
const MAX_BACKLOG: usize = 256 * 1024;

/// An open link.
pub enum Link {
    /// Over UDP, either way.
    Udp {
        /// Our socket.
        socket: UdpSocket,
        /// The fixed peer of `udpout`.
        target: Option<SocketAddr>,
        /// Who has spoken to us lately.
        peers: Vec<(SocketAddr, Instant)>,
    },
    /// Over TCP.
    Tcp {
        /// Where clients knock.
        listener: TcpListener,
        /// The client, and what it has not taken yet.
        client: Option<(TcpStream, Vec<u8>)>,
    },
}

impl Link {
    /// Opens a link.
    ///
    /// # Errors
    /// Returns the operating system's refusal, of a port in use above all.
    pub fn open(endpoint: Endpoint) -> io::Result<Self> {
        Ok(match endpoint {
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
                Self::Tcp { listener, client: None }
            }
        })
    }

    /// Returns the address others reach us at, or for `udpout` the one we send from.
    ///
    /// # Errors
    /// Returns the operating system's refusal.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        match self {
            Self::Udp { socket, .. } => socket.local_addr(),
            Self::Tcp { listener, .. } => listener.local_addr(),
        }
    }

    /// Hands everything that has come to `sink`; at most 64 pieces, so that a flood cannot stop
    /// the flight.
    pub fn receive(&mut self, mut sink: impl FnMut(&[u8])) {
        let mut buffer = [0; 2048];
        match self {
            Self::Udp { socket, target, peers } => {
                for _ in 0..64 {
                    match socket.recv_from(&mut buffer) {
                        Ok((length, sender)) => {
                            if target.is_none() {
                                remember(peers, sender);
                            }
                            sink(&buffer[..length]);
                        }
                        Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                        // A peer that is not there yet reports itself as refused: go on.
                        Err(_) => {}
                    }
                }
            }
            Self::Tcp { listener, client } => {
                if let Ok((stream, _)) = listener.accept()
                    && client.is_none()
                    && stream.set_nonblocking(true).is_ok()
                {
                    // Small packets must not wait for each other; failing that they merely do.
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

    /// Sends one packet to everybody.
    pub fn send(&mut self, packet: &[u8]) {
        match self {
            Self::Udp { socket, target, peers } => {
                peers.retain(|(_, heard)| heard.elapsed() < PEER_SILENCE);
                for address in target.iter().chain(peers.iter().map(|(address, _)| address)) {
                    // Lost like any datagram: the autopilot does not learn of it either.
                    let _ = socket.send_to(packet, address);
                }
            }
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

/// Binds a non-blocking UDP socket.
///
/// # Errors
/// Returns the operating system's refusal.
pub fn bind_udp(address: impl ToSocketAddrs) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

fn remember(peers: &mut Vec<(SocketAddr, Instant)>, sender: SocketAddr) {
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
    fn endpoints_read_and_print() {
        for text in ["udpout:127.0.0.1:14550", "udpin:0.0.0.0:14550", "tcpin:127.0.0.1:5760"] {
            assert_eq!(text.parse::<Endpoint>().unwrap().to_string(), text);
        }
        for text in ["", "udp:1.2.3.4:5", "udpout", "udpout:127.0.0.1", "tcpin:127.0.0.1:99999"] {
            let error = text.parse::<Endpoint>().unwrap_err();
            assert!(error.to_string().contains("udpout:HOST:PORT"));
        }
    }
}
