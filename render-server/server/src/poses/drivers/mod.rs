//! Sources of poses. A driver owns its socket; the parser beside it is sans-IO.
//!
//! ```text
//! datagrams -> udp (socket, arrival stamp) -> vicon, natnet, json, mavlink (bytes -> objects)
//!           -> vehicle_names (which vehicle's; into the world frame; counters; what is odd)
//!           -> frame_clock, sender_clock (stamp without the network's jitter)
//!           -> Measurements -> multi_source (where there are several) -> pose thread
//! ```
//! 30 to 300 Hz. The pose thread of [`crate::poses::thread`] owns the source and calls
//! [`PoseSource::receive`]. Which sources there are: [`open`].

pub mod frame_clock;
pub mod json;
pub mod mavlink;
mod multi_source;
pub mod natnet;
pub mod sender_clock;
mod source;
pub mod udp;
mod vehicle_names;
pub mod vicon;

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs};

use anyhow::{Context, Result};

use self::json::JsonStream;
use self::mavlink::MavlinkStream;
use self::multi_source::MultiSource;
use self::natnet::{COMMAND_PORT, Motive, NatnetStream};
pub use self::source::{Measurement, PoseSource, SourceCounters, TagsSeen};
use self::udp::UdpPort;
use self::vicon::ViconStream;
use crate::poses::settings::{Driver, LocalizationConfig};

/// A source whose address is taken, and which waits for the names of the vehicles.
#[derive(Debug)]
pub struct Opened {
    config: LocalizationConfig,
    port: UdpPort,
    motive: Motive,
}

/// Takes the addresses of sources, in their order.
///
/// # Errors
/// Names an address that cannot be used, and what to do.
pub fn open(configs: &[LocalizationConfig]) -> Result<Vec<Opened>> {
    configs.iter().map(Opened::open).collect()
}

/// Makes one source of several, which looks for the vehicles named, by their index.
///
/// # Errors
/// If a thread cannot be started.
pub fn track(opened: Vec<Opened>, vehicles: &[&str]) -> Result<Box<dyn PoseSource>> {
    let mut sources: Vec<_> = opened
        .into_iter()
        .enumerate()
        .map(|(index, opened)| opened.track(index as u8, vehicles))
        .collect();
    if sources.len() == 1 {
        // Without a thread between socket and referee.
        return Ok(sources.remove(0));
    }
    Ok(Box::new(MultiSource::start(sources)?))
}

impl Opened {
    fn open(config: &LocalizationConfig) -> Result<Self> {
        let driver = config.driver;
        let mut config = config.clone();
        if driver == Driver::Natnet && !config.address().contains(':') {
            config.address = Some(format!("{}:{COMMAND_PORT}", config.address()));
        }
        let at = address(&config)?;
        let (port, motive) = match (driver, at) {
            (Driver::Vicon | Driver::Json | Driver::Mavlink, _) => {
                (UdpPort::bind(driver, at)?, Motive::Multicast)
            }
            (Driver::Natnet, SocketAddr::V4(group)) if group.ip().is_multicast() => {
                let interface = config.interface.unwrap_or(Ipv4Addr::UNSPECIFIED);
                let port = UdpPort::join(driver, *group.ip(), group.port(), interface)?;
                (port, Motive::Multicast)
            }
            (Driver::Natnet, server) => {
                let any: SocketAddr = match server {
                    SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
                    SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
                };
                (UdpPort::bind(driver, any)?, Motive::Unicast(server))
            }
        };
        Ok(Self { config, port, motive })
    }

    /// Returns who sends.
    pub fn driver(&self) -> Driver {
        self.config.driver
    }

    /// Returns where its stream must be sent, if it arrives at a socket of ours unasked.
    pub fn socket(&self) -> Option<SocketAddr> {
        (self.motive == Motive::Multicast).then_some(self.port.address())
    }

    /// Returns where it arrives or is asked for, for people.
    pub fn address(&self) -> String {
        match self.motive {
            Motive::Multicast => self.port.address().to_string(),
            Motive::Unicast(server) => server.to_string(),
        }
    }

    fn track(self, source: u8, vehicles: &[&str]) -> Box<dyn PoseSource> {
        let Self { config, port, motive } = self;
        match config.driver {
            Driver::Json => Box::new(port.with(JsonStream::new(&config, source, vehicles))),
            Driver::Natnet => {
                Box::new(port.with(NatnetStream::new(&config, source, vehicles, motive)))
            }
            Driver::Mavlink => Box::new(port.with(MavlinkStream::new(&config, source, vehicles))),
            Driver::Vicon => Box::new(port.with(ViconStream::new(&config, source, vehicles))),
        }
    }
}

/// Returns a source's address, HOST:PORT, resolved.
fn address(config: &LocalizationConfig) -> Result<SocketAddr> {
    let (driver, text) = (config.driver, config.address());
    let advice = || format!("{driver}: '{text}' is no HOST:PORT, as {}", driver.usual_address());
    text.to_socket_addrs().with_context(advice)?.next().with_context(advice)
}
