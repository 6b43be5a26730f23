//! Pose sources. A driver owns its socket; its parser is sans-IO.
//!
//! ```text
//! datagrams -> udp (socket), arrival (the kernel's stamp) -> vicon, natnet, json, mavlink (bytes -> objects)
//! bytes ----> vrpn::connection (TCP, arrival stamp) -> vrpn
//!           -> vehicle_names (vehicle of an object; world frame; counters; warnings)
//!           -> sender (one sender for each vehicle)
//!           -> frame_clock, sender_clock (stamps without network jitter)
//!           -> Measurements -> multi_source (for several sources) -> pose thread
//! ```
//! Sources send 30 to 300 Hz. The pose thread of [`crate::poses::thread`] owns the source and calls
//! [`PoseSource::receive`]. [`open`] creates the sources.

mod arrival;
pub mod frame_clock;
pub mod json;
#[cfg(test)]
mod lost_poses;
pub mod mavlink;
mod multi_source;
pub mod natnet;
mod sender;
pub mod sender_clock;
mod slew;
mod source;
pub mod udp;
mod vehicle_names;
pub mod vicon;
pub mod vrpn;

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs};

use anyhow::{Context, Result};

use self::json::JsonStream;
use self::mavlink::MavlinkStream;
use self::multi_source::MultiSource;
use self::natnet::{COMMAND_PORT, Motive, NatnetStream};
pub use self::source::{Measurement, PoseSource, SourceCounters, TagsSeen};
use self::udp::UdpPort;
use self::vicon::ViconStream;
use self::vrpn::VrpnStream;
use self::vrpn::connection::VrpnPoses;
use crate::poses::settings::{Driver, LocalizationConfig};

/// Source with a bound address, before the names of the vehicles are known.
#[derive(Debug)]
pub struct Opened {
    config: LocalizationConfig,
    port: Port,
}

/// Socket or server address of a driver.
#[derive(Debug)]
enum Port {
    Vicon(UdpPort),
    Natnet(UdpPort, Motive),
    Json(UdpPort),
    Mavlink(UdpPort),
    Vrpn(SocketAddr),
}

/// Binds the addresses of all sources, in order.
///
/// # Errors
/// Names an address that cannot be used, and the fix.
pub fn open(configs: &[LocalizationConfig]) -> Result<Vec<Opened>> {
    configs.iter().map(Opened::open).collect()
}

/// Combines all sources into one, for the named vehicles, by index.
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
        // A single source needs no thread between socket and referee.
        return Ok(sources.remove(0));
    }
    Ok(Box::new(MultiSource::start(sources)?))
}

impl Opened {
    fn open(config: &LocalizationConfig) -> Result<Self> {
        let driver = config.driver;
        let mut config = config.clone();
        let usual_port = match driver {
            Driver::Natnet => Some(COMMAND_PORT),
            Driver::Vrpn => Some(vrpn::PORT),
            Driver::Vicon | Driver::Json | Driver::Mavlink => None,
        };
        if let Some(port) = usual_port.filter(|_| !config.address().contains(':')) {
            config.address = Some(format!("{}:{port}", config.address()));
        }
        let at = address(&config)?;
        let port = match driver {
            Driver::Vicon => Port::Vicon(UdpPort::bind(driver, at)?),
            Driver::Json => Port::Json(UdpPort::bind(driver, at)?),
            Driver::Mavlink => Port::Mavlink(UdpPort::bind(driver, at)?),
            Driver::Natnet => {
                let (port, motive) = open_natnet(&config, at)?;
                Port::Natnet(port, motive)
            }
            Driver::Vrpn => Port::Vrpn(at),
        };
        Ok(Self { config, port })
    }

    /// Returns the driver.
    pub fn driver(&self) -> Driver {
        self.config.driver
    }

    /// Returns the address to which data must be sent; `None` if the driver requests them.
    pub fn socket(&self) -> Option<SocketAddr> {
        match &self.port {
            Port::Vicon(port)
            | Port::Json(port)
            | Port::Mavlink(port)
            | Port::Natnet(port, Motive::Multicast) => Some(port.address()),
            Port::Natnet(_, Motive::Unicast(_)) | Port::Vrpn(_) => None,
        }
    }

    /// Returns the address for display: of the socket, or of the server that is queried.
    pub fn address(&self) -> String {
        match &self.port {
            Port::Natnet(_, Motive::Unicast(server)) | Port::Vrpn(server) => *server,
            Port::Vicon(port)
            | Port::Json(port)
            | Port::Mavlink(port)
            | Port::Natnet(port, Motive::Multicast) => port.address(),
        }
        .to_string()
    }

    fn track(self, source: u8, vehicles: &[&str]) -> Box<dyn PoseSource> {
        let config = &self.config;
        match self.port {
            Port::Vicon(port) => Box::new(port.with(ViconStream::new(config, source, vehicles))),
            Port::Natnet(port, motive) => {
                Box::new(port.with(NatnetStream::new(config, source, vehicles, motive)))
            }
            Port::Json(port) => Box::new(port.with(JsonStream::new(config, source, vehicles))),
            Port::Mavlink(port) => {
                Box::new(port.with(MavlinkStream::new(config, source, vehicles)))
            }
            Port::Vrpn(server) => {
                Box::new(VrpnPoses::new(server, VrpnStream::new(config, source, vehicles)))
            }
        }
    }
}

/// Joins Motive's multicast group, or opens a socket for unicast streaming.
fn open_natnet(config: &LocalizationConfig, at: SocketAddr) -> Result<(UdpPort, Motive)> {
    let any: SocketAddr = match at {
        SocketAddr::V4(group) if group.ip().is_multicast() => {
            let interface = config.interface.unwrap_or(Ipv4Addr::UNSPECIFIED);
            let port = UdpPort::join(Driver::Natnet, *group.ip(), group.port(), interface)?;
            return Ok((port, Motive::Multicast));
        }
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    Ok((UdpPort::bind(Driver::Natnet, any)?, Motive::Unicast(at)))
}

/// Resolves a source's address HOST:PORT.
fn address(config: &LocalizationConfig) -> Result<SocketAddr> {
    let (driver, text) = (config.driver, config.address());
    let advice =
        || format!("{driver}: '{text}' is not HOST:PORT, for example {}", driver.usual_address());
    text.to_socket_addrs().with_context(advice)?.next().with_context(advice)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queried_servers_have_a_default_port_and_no_socket() {
        for (pose, address) in [
            ("natnet:10.0.0.5", "10.0.0.5:1510"),
            ("vrpn:10.0.0.5", "10.0.0.5:3883"),
            ("vrpn:10.0.0.5:4000", "10.0.0.5:4000"),
            ("vrpn", "127.0.0.1:3883"),
        ] {
            let opened = open(&[LocalizationConfig::parse(pose).unwrap()]).unwrap();
            assert_eq!((opened[0].address().as_str(), opened[0].socket()), (address, None));
        }
        let opened = open(&[LocalizationConfig::parse("json:127.0.0.1:0").unwrap()]).unwrap();
        assert_eq!(opened[0].socket().unwrap().to_string(), opened[0].address());
    }
}
