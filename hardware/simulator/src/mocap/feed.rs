//! Sends measured poses over UDP in the formats of several vendors.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::str::FromStr;

use vizflyt_protocol::time::AutopilotTime;

use super::Sight;
use super::formats::{answer_natnet, encode_json, encode_mavlink, encode_natnet, encode_object};
use crate::link::{bind_udp, resolve};

/// Format and destination, for example `json:127.0.0.1:51002`. For NatNet, the address is the one at which Motive takes
/// commands, or its multicast group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeedTarget {
    pub format: Format,
    pub address: SocketAddr,
}

/// Format of measured poses on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Vicon Tracker's UDP object stream.
    Vicon,
    /// OptiTrack Motive's NatNet 4.1, y up.
    Natnet,
    /// VizFlyt's own pose packet.
    Json,
    /// The estimate of an autopilot, as MAVLink.
    Mavlink,
}

impl Format {
    const ALL: [(&'static str, Self); 4] = [
        ("vicon", Self::Vicon),
        ("natnet", Self::Natnet),
        ("json", Self::Json),
        ("mavlink", Self::Mavlink),
    ];
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::ALL.iter().find(|(_, format)| format == self).map_or("", |(name, _)| name);
        f.write_str(name)
    }
}

impl FromStr for FeedTarget {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let read = || {
            let (name, address) = text.split_once(':')?;
            let (_, format) = Format::ALL.iter().find(|(known, _)| *known == name)?;
            Some(Self { format: *format, address: resolve(address)? })
        };
        read().ok_or_else(|| {
            let names = Format::ALL.map(|(name, _)| name).join(", ");
            format!("'{text}': write FORMAT:HOST:PORT; formats are {names}")
        })
    }
}

/// One simulated system on the network.
#[derive(Debug)]
pub struct Feed {
    target: FeedTarget,
    socket: UdpSocket,
    /// NatNet listeners by unicast, and when each last sent a command.
    listeners: Vec<(SocketAddr, AutopilotTime)>,
}

impl Feed {
    /// Opens the socket.
    ///
    /// # Errors
    /// If no socket can be opened, or NatNet's address is in use.
    pub fn open(target: FeedTarget) -> std::io::Result<Self> {
        let ours = match target.address.ip() {
            ip if target.format == Format::Natnet && !ip.is_multicast() => target.address,
            ip if target.format == Format::Natnet => (any(ip), COMMAND_PORT).into(),
            ip => (any(ip), 0).into(),
        };
        Ok(Self { target, socket: bind_udp(ours)?, listeners: Vec::new() })
    }

    /// Returns the local address of the socket.
    ///
    /// # Errors
    /// If the operating system does not report it.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Sends the measured pose of the vehicle named `object`. For NatNet, answers commands first.
    pub fn send(&mut self, object: &str, sight: &Sight, now: AutopilotTime) {
        let to = self.target.address;
        let datagram = match self.target.format {
            Format::Vicon => encode_object(sight.frame, object, &sight.world_from_body).to_vec(),
            Format::Json => encode_json(object, sight),
            Format::Mavlink => encode_mavlink(sight),
            Format::Natnet => {
                self.answer(object, now);
                let Some(datagram) = encode_natnet(sight, now) else { return };
                if !to.ip().is_multicast() {
                    for (listener, _) in &self.listeners {
                        let _ = self.socket.send_to(&datagram, listener);
                    }
                    return;
                }
                datagram
            }
        };
        // Without a receiver, the datagram is lost.
        let _ = self.socket.send_to(&datagram, to);
    }

    fn answer(&mut self, object: &str, now: AutopilotTime) {
        let mut buffer = [0; 2048];
        // Bounded, so that another program cannot keep this loop busy.
        for _ in 0..MAX_LISTENERS {
            // An error means an empty socket, or that a receiver is gone.
            let Ok((length, from)) = self.socket.recv_from(&mut buffer) else { break };
            if let Some((_, received_at)) =
                self.listeners.iter_mut().find(|(known, _)| *known == from)
            {
                *received_at = now;
            } else if self.listeners.len() < MAX_LISTENERS {
                self.listeners.push((from, now));
            } else {
                continue;
            }
            if let Some(answer) = answer_natnet(object, &buffer[..length]) {
                let _ = self.socket.send_to(&answer, from);
            }
        }
        self.listeners.retain(|(_, received_at)| now.seconds_since(*received_at) < FORGOTTEN_S);
    }
}

fn any(like: IpAddr) -> IpAddr {
    if like.is_ipv4() {
        Ipv4Addr::UNSPECIFIED.into()
    } else {
        std::net::Ipv6Addr::UNSPECIFIED.into()
    }
}

/// Port on which Motive takes commands.
const COMMAND_PORT: u16 = 1510;
/// Maximum number of listeners by unicast.
const MAX_LISTENERS: usize = 16;
/// Silence after which a listener is removed [s].
const FORGOTTEN_S: f64 = 5.0;
