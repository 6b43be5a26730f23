//! Sends sights over UDP as one vendor's system or another does.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::str::FromStr;

use vizflyt_protocol::time::AutopilotTime;

use super::Sight;
use super::formats::{answer_natnet, encode_json, encode_mavlink, encode_natnet, encode_object};
use crate::link::{bind_udp, resolve};

/// A vendor's format, and where it goes: `json:127.0.0.1:51002`. NatNet's is where Motive takes
/// commands, or the multicast group that it streams to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeedTarget {
    /// Its format.
    pub format: Format,
    /// Where it goes.
    pub address: SocketAddr,
}

/// How sights are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Vicon Tracker's UDP object stream.
    Vicon,
    /// OptiTrack Motive's NatNet 4.1, y up.
    Natnet,
    /// VizFlyt's own pose packet.
    Json,
    /// An autopilot's own estimate.
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

/// One system on the network.
#[derive(Debug)]
pub struct Feed {
    target: FeedTarget,
    socket: UdpSocket,
    /// NatNet's listeners, and when they last sent something.
    listeners: Vec<(SocketAddr, AutopilotTime)>,
}

impl Feed {
    /// Opens its socket.
    ///
    /// # Errors
    /// If there is none, or NatNet's address is taken.
    pub fn open(target: FeedTarget) -> std::io::Result<Self> {
        let ours = match target.address.ip() {
            ip if target.format == Format::Natnet && !ip.is_multicast() => target.address,
            ip if target.format == Format::Natnet => (any(ip), COMMAND_PORT).into(),
            ip => (any(ip), 0).into(),
        };
        Ok(Self { target, socket: bind_udp(ours)?, listeners: Vec::new() })
    }

    /// Returns the socket's own address.
    ///
    /// # Errors
    /// If the operating system does not report it.
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Sends where the vehicle named `object` was seen; first answers who has asked.
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
        // Lost like any datagram if nobody listens.
        let _ = self.socket.send_to(&datagram, to);
    }

    fn answer(&mut self, object: &str, now: AutopilotTime) {
        let mut buffer = [0; 2048];
        // As many as may wait: a loop that another program could keep busy.
        for _ in 0..MAX_LISTENERS {
            // Errors are an empty socket, or a complaint that someone has gone.
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

/// Where Motive takes commands.
const COMMAND_PORT: u16 = 1510;
/// Listeners by unicast at most.
const MAX_LISTENERS: usize = 16;
/// Who is silent for so long is forgotten. [s]
const FORGOTTEN_S: f64 = 5.0;
