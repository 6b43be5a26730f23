//! Sources of poses. A driver owns its socket; the parser beside it is sans-IO.
//!
//! ```text
//! datagrams -> udp (socket, arrival stamp) -> vicon, natnet, json, mavlink (bytes -> objects)
//!           -> roster (which vehicle's; into the world frame; counters; what is odd)
//!           -> frame_clock, sender_clock (stamp without the network's jitter)
//!           -> Measurements -> several (where there are) -> tick
//! ```
//! 30 to 300 Hz. The pose thread of [`crate::poses::thread`] owns the source and calls
//! [`PoseSource::receive`]. Which sources there are: [`open`].

pub mod frame_clock;
pub mod json;
pub mod mavlink;
mod multi_source;
pub mod natnet;
pub mod sender_clock;
pub mod udp;
mod vehicle_names;
pub mod vicon;

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs};
use std::time::Duration;

use anyhow::{Context, Result};
use vizflyt_arena::config::{Driver, LocalizationConfig};
use vizflyt_arena::pose::{Measured, PoseSigma};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

use self::json::JsonStream;
use self::mavlink::MavlinkStream;
use self::multi_source::MultiSource;
use self::natnet::{COMMAND_PORT, Motive, NatnetStream};
use self::udp::UdpPort;
use self::vicon::ViconStream;

/// One raw pose of a vehicle, as its localization system gave it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index of the source, in the order in which they were set up.
    pub source: u8,
    /// When the pose was true, as well as the source lets one tell.
    pub stamp: ServerTime,
    /// When it reached this computer.
    pub arrival: ServerTime,
    /// Where the vehicle was.
    pub world_from_body: Pose<World, Body>,
    /// How far that may be off, where the source says.
    pub sigma: Option<PoseSigma>,
}

impl Measurement {
    /// Returns what the pose filter is to know of it.
    pub fn with_covariance(&self) -> Measured {
        let Self { source, stamp, arrival, world_from_body, sigma, .. } = *self;
        Measured { source, stamp, arrival, world_from_body, sigma }
    }
}

/// Yields poses; owns its I/O.
pub trait PoseSource: Send {
    /// Waits at most `timeout` for the next poses, which came together, at most one of each
    /// vehicle; none if none came.
    fn receive(&mut self, timeout: Duration) -> &[Measurement];

    /// Returns what a person should know by now, once per occurrence.
    fn next_warning(&mut self) -> Option<String>;

    /// Returns the counters of a vehicle, for the page and the report.
    fn counters(&self, vehicle: usize) -> SourceCounters;
}

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

/// What came in of one vehicle, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct SourceCounters {
    /// Poses of the vehicle used.
    pub poses: u64,
    /// Packets that did not parse, of whatever vehicle.
    pub bad_packets: u64,
    /// Packets that came twice or out of order.
    pub stale_packets: u64,
    /// Frames that never came, by the frame counter.
    pub lost_frames: u64,
    /// Frames in which the vehicle was not seen.
    pub occluded: u64,
    /// Poses that the referee's gate did not believe; counted by the pose thread.
    pub rejected: u64,
    /// What the newest pose rests on, where it comes of tags.
    pub tags: Option<TagsSeen>,
}

/// What a pose rests on that comes of tags, as `vizflyt tags locate` says.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TagsSeen {
    /// How many; one in two cameras counts twice.
    pub tags: u32,
    /// In how many cameras.
    pub cameras: u32,
    /// Root mean square distance of corners from where the pose puts them. [px]
    pub rms_px: f32,
    /// Time to find them in an image. [ms]
    pub image_ms: f32,
    /// Port of the live view on the computer that sees them.
    #[serde(default, skip_serializing)]
    pub view_port: Option<u16>,
    /// Where the live view is.
    #[serde(skip_deserializing)]
    pub view: Option<SocketAddr>,
}

impl SourceCounters {
    /// Returns the counters of several vehicles of one source together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        Self {
            poses: self.poses + other.poses,
            // Counted once for all.
            bad_packets: self.bad_packets.max(other.bad_packets),
            stale_packets: self.stale_packets + other.stale_packets,
            lost_frames: self.lost_frames + other.lost_frames,
            occluded: self.occluded + other.occluded,
            rejected: self.rejected + other.rejected,
            tags: self.tags.or(other.tags),
        }
    }
}
