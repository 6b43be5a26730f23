//! QUIC to the runtime: one endpoint, one session per connection.
//!
//! ```text
//! accept -> limits: attempts per address; address validation under load; handshakes per address
//!        -> pairing, if the client requests it; else
//!        -> greeting: identity, preambles, Hello -> Welcome | Refused
//!        -> session: control stream: poses, events, clock down; telemetry, events, clock up
//!        -> readings of other sensors: one uni stream each, the newest, behind images
//!        -> images: one uni stream each, at most K in flight per camera, reset after a deadline
//!        -> feed: sealed poses to the flight's guardian, over UDP, also after the connection has ended
//! ```
//! Settings and figures: docs/BENCHMARKS.md.

mod control;
mod feed;
mod greeting;
mod images;
mod lan;
mod pairing;
mod readings;
mod session;

pub use lan::{Lan, LanConfig};

use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use quinn::congestion::{BbrConfig, ControllerFactory};
use quinn::crypto::rustls::{HandshakeData, QuicServerConfig};
use quinn::{
    AckFrequencyConfig, Connection, Endpoint, EndpointConfig, MtuDiscoveryConfig, ServerConfig,
    TransportConfig, VarInt,
};
use quinn_proto::HashedConnectionIdGenerator;
use ring::hmac;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::sync::{Notify, Semaphore};
use tracing::{debug, warn};
use vizflyt_protocol::messages::close;
use vizflyt_trust::{ALPN, ALPN_PAIR, Identity, tls};

use crate::admission::{Admission, Limits, PlaceId};
use crate::authorization::Authorizer;
use crate::rate_limit::RateLimiter;
use crate::stream::Rooms;
use crate::stream::rate_control::is_near;
use vizflyt_process::lock;

/// Congestion control of the image stream
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Congestion {
    /// `lan` to private and loopback addresses, `bbr` to all others
    #[default]
    Auto,
    /// Constant window that ignores loss; for a dedicated cable
    Lan,
    /// Fair to other senders, less sensitive to loss (experimental in quinn)
    Bbr,
}

impl Congestion {
    /// Resolves `Auto` for a peer at `address`.
    fn toward(self, address: IpAddr) -> Self {
        match self {
            Self::Auto if is_near(address) => Self::Lan,
            Self::Auto => Self::Bbr,
            chosen => chosen,
        }
    }

    fn factory(self) -> Arc<dyn ControllerFactory + Send + Sync> {
        match self {
            Self::Auto | Self::Lan => Arc::new(LanConfig::default()),
            Self::Bbr => Arc::new(BbrConfig::default()),
        }
    }
}

/// Opens the endpoint. Must run within a tokio runtime.
pub fn bind(address: SocketAddr, identity: &Identity, congestion: Congestion) -> Result<Endpoint> {
    let open = || -> std::io::Result<std::net::UdpSocket> {
        let socket = Socket::new(Domain::for_address(address), Type::DGRAM, Some(Protocol::UDP))?;
        // The kernel may grant less (net.core.wmem_max); more than 212 KB already helps.
        socket.set_send_buffer_size(SOCKET_BUFFER)?;
        socket.set_recv_buffer_size(SOCKET_BUFFER)?;
        socket.bind(&address.into())?;
        socket.set_nonblocking(true)?;
        Ok(socket.into())
    };
    let socket = open().with_context(|| {
        format!(
            "cannot listen on {address} (QUIC); is another server running? try --quic 0.0.0.0:0"
        )
    })?;
    let config = server_config(identity, congestion)?;
    Endpoint::new(endpoint_config(identity)?, Some(config), socket, Arc::new(quinn::TokioRuntime))
        .context("cannot start QUIC")
}

/// Returns the settings of the endpoint itself.
///
/// Its secrets are derived from the identity instead of chosen at random. After a crash and restart, the server
/// can thus answer packets of the previous process with a stateless reset (RFC 9000, section 10.3), and the
/// runtime reconnects at once instead of after seconds of silence.
pub fn endpoint_config(identity: &Identity) -> Result<EndpointConfig> {
    let secret = |purpose: &[u8]| {
        let key = hmac::Key::new(hmac::HMAC_SHA256, identity.key.secret_der());
        hmac::sign(&key, purpose)
    };
    let reset = hmac::Key::new(hmac::HMAC_SHA256, secret(b"vizflyt stateless reset").as_ref());
    let mut ids = [0; 8];
    ids.copy_from_slice(&secret(b"vizflyt connection ids").as_ref()[..8]);
    let ids = u64::from_le_bytes(ids);
    let mut endpoint = EndpointConfig::new(Arc::new(reset));
    endpoint.cid_generator(move || Box::new(HashedConnectionIdGenerator::from_key(ids)));
    // Accepts jumbo packets, if the peer's network supports them.
    endpoint.max_udp_payload_size(MAX_MTU).context("cannot set the packet size")?;
    Ok(endpoint)
}

/// Accepts runtimes until the server stops.
pub async fn serve(
    rooms: Rooms,
    endpoint: Endpoint,
    authorizer: Arc<Authorizer>,
    congestion: Congestion,
) {
    let mut sessions = tokio::task::JoinSet::new();
    let port = endpoint.local_addr().map_or(0, |address| address.port());
    let unknown_peers = Arc::new(UnknownPeers::default());
    let feed = async {
        let bound = match endpoint.local_addr() {
            Ok(quic) => feed::bind(quic).await,
            Err(error) => Err(error),
        };
        match bound.and_then(|socket| Ok((socket.local_addr()?.port(), socket))) {
            Ok((port, socket)) => {
                rooms.streaming.feed_port.store(port, Ordering::Relaxed);
                feed::serve(&rooms, socket).await;
            }
            Err(error) => warn!("no pose feed for guardians: {error}"),
        }
        std::future::pending::<()>().await;
    };
    let mut feed = std::pin::pin!(feed);
    loop {
        let incoming = tokio::select! {
            incoming = endpoint.accept() => incoming,
            _ = sessions.join_next(), if !sessions.is_empty() => continue,
            () = &mut feed => continue,
            () = rooms.stop.wait() => None,
        };
        let Some(incoming) = incoming else { break };
        let address = incoming.remote_address();
        if sessions.len() >= MAX_CONNECTIONS + MAX_HANDSHAKES {
            debug!("{} connections already: refused {address}", sessions.len());
            incoming.refuse();
            continue;
        }
        if !unknown_peers.may_try(address.ip()) {
            debug!("{address}: refused: too many attempts");
            incoming.refuse();
            continue;
        }
        // Under load an address must first prove that packets reach it; this costs the server no memory and no
        // slot.
        if unknown_peers.handshakes_under_way() >= RETRY_ABOVE && incoming.may_retry() {
            if let Err(error) = incoming.retry() {
                debug!("{address}: {error}");
            }
            continue;
        }
        let Some((handshake, gives_way)) = unknown_peers.handshake(address.ip()) else {
            incoming.refuse();
            continue;
        };
        let chosen = congestion.toward(address.ip());
        let config = match server_config(&authorizer.identity, chosen) {
            Ok(config) => Arc::new(config),
            Err(error) => {
                warn!("{error:#}");
                continue;
            }
        };
        let (rooms, authorizer, unknown_peers) =
            (rooms.clone(), authorizer.clone(), unknown_peers.clone());
        sessions.spawn(async move {
            let shaken = async {
                match incoming.accept_with(config) {
                    Ok(connecting) => tokio::time::timeout(HANDSHAKE_WITHIN, connecting).await,
                    Err(error) => Ok(Err(error)),
                }
            };
            let connection = tokio::select! {
                connection = shaken => connection,
                () = gives_way.notified() => {
                    return debug!("{address}: its handshake gave way to a newer one");
                }
            };
            drop(handshake);
            let connection = match connection {
                Ok(Ok(connection)) => connection,
                Ok(Err(error)) => return debug!("{address}: no connection: {error}"),
                Err(_) => return debug!("{address}: the handshake took too long"),
            };
            let known =
                greeting::peer(&connection).is_some_and(|who| authorizer.client(who).is_some());
            let pairing = is_pairing(&connection);
            if pairing || !known {
                unknown_peers.charge(address.ip());
            }
            if pairing {
                let Ok(_place) = unknown_peers.pairings.try_acquire() else {
                    return connection.close(REFUSED, b"others are being paired; try again");
                };
                Box::pin(pairing::run(&authorizer, &connection)).await;
            } else {
                Box::pin(greeting::run(rooms, authorizer, port, connection)).await;
            }
        });
    }
    sessions.shutdown().await;
    endpoint.close(END, b"the server ends");
    // Long enough for the close to reach a runtime on the LAN; nothing depends on it.
    let _ = tokio::time::timeout(Duration::from_millis(300), endpoint.wait_idle()).await;
}

/// Returns whether the client connected for pairing.
fn is_pairing(connection: &Connection) -> bool {
    let data = connection.handshake_data().and_then(|data| data.downcast::<HandshakeData>().ok());
    data.is_some_and(|data| data.protocol.as_deref() == Some(ALPN_PAIR))
}

/// Limits for clients that are not yet known.
#[derive(Debug)]
struct UnknownPeers {
    limiter: Mutex<RateLimiter>,
    handshakes: Mutex<Admission<Arc<Notify>>>,
    pairings: Semaphore,
}

impl Default for UnknownPeers {
    fn default() -> Self {
        let limits = Limits {
            strangers: MAX_HANDSHAKES,
            by_address: MAX_HANDSHAKES_BY_ADDRESS,
            teams: 0,
            by_team: 0,
            instructors: 0,
        };
        let handshakes = Mutex::new(Admission::new(limits));
        Self { limiter: Mutex::default(), handshakes, pairings: Semaphore::new(MAX_PAIRINGS) }
    }
}

/// Handshake in progress; its slot is free again when this is dropped.
struct Handshake {
    peers: Arc<UnknownPeers>,
    place: PlaceId,
}

impl UnknownPeers {
    fn may_try(&self, address: IpAddr) -> bool {
        lock(&self.limiter).may_try(Instant::now(), address)
    }

    fn handshakes_under_way(&self) -> usize {
        lock(&self.handshakes).len()
    }

    /// Begins a handshake with `address`. Returns it, and the signal to give way to a newer one.
    fn handshake(self: &Arc<Self>, address: IpAddr) -> Option<(Handshake, Arc<Notify>)> {
        let gives_way = Arc::new(Notify::new());
        let admitted = lock(&self.handshakes).admit(Instant::now(), address, gives_way.clone());
        let (place, oldest) = admitted?;
        if let Some(oldest) = oldest {
            oldest.notify_one();
        }
        Some((Handshake { peers: self.clone(), place }, gives_way))
    }

    fn charge(&self, address: IpAddr) {
        lock(&self.limiter).charge(Instant::now(), address);
    }
}

impl Drop for Handshake {
    fn drop(&mut self) {
        lock(&self.peers.handshakes).leave(self.place);
    }
}

/// Returns the settings of connections, with the certificate that runtimes pin.
pub fn server_config(identity: &Identity, congestion: Congestion) -> Result<ServerConfig> {
    let tls = tls::server_config(identity, &[ALPN, ALPN_PAIR])
        .context("cannot use the server's key for TLS")?;
    let quic = QuicServerConfig::try_from(tls).context("cannot use TLS for QUIC")?;
    let mut config = ServerConfig::with_crypto(Arc::new(quic));
    config.transport_config(Arc::new(transport_config(congestion)));
    Ok(config)
}

fn transport_config(congestion: Congestion) -> TransportConfig {
    let mut ack = AckFrequencyConfig::default();
    ack.ack_eliciting_threshold(VarInt::from_u32(10)).max_ack_delay(Some(Duration::from_millis(2)));
    let mut mtu = MtuDiscoveryConfig::default();
    mtu.upper_bound(MAX_MTU - 48); // less the IPv6 and UDP headers
    let mut config = TransportConfig::default();
    config
        .max_concurrent_bidi_streams(VarInt::from_u32(1)) // control stream
        .max_concurrent_uni_streams(VarInt::from_u32(0)) // a runtime sends no images
        .stream_receive_window(VarInt::from_u32(256 << 10)) // telemetry is small
        .receive_window(VarInt::from_u32(256 << 10))
        .send_window(4 << 20) // the default of 10 MB would queue stale images
        .datagram_receive_buffer_size(Some(POSES_WAITING)) // with `None`, quinn would not send any
        .datagram_send_buffer_size(POSES_WAITING)
        .max_idle_timeout(Some(VarInt::from_u32(5_000).into()))
        .keep_alive_interval(Some(Duration::from_secs(1)))
        .ack_frequency_config(Some(ack))
        .mtu_discovery_config(Some(mtu))
        .enable_segmentation_offload(true)
        .congestion_controller_factory(congestion.factory());
    config
}

/// Close codes; the reason follows as text.
const END: VarInt = VarInt::from_u32(0);
const FOREIGN: VarInt = VarInt::from_u32(1);
const REFUSED: VarInt = VarInt::from_u32(2);
const SLOW: VarInt = VarInt::from_u32(3);
const REPLACED: VarInt = VarInt::from_u32(4);
const UNPAIRED: VarInt = VarInt::from_u32(close::UNPAIRED);
/// Measured: 600 KB images from 2.7 to 1.8 ms, no packets lost in the socket.
const SOCKET_BUFFER: usize = 4 << 20;
/// Jumbo frames. [bytes]
const MAX_MTU: u16 = 9000;
/// Maximum handshakes in progress: each costs about 10 KB and a signature, before the client is identified.
const MAX_HANDSHAKES: usize = 32;
/// Maximum per address; the oldest gives way. At 40 half-open ones a second each has 0.2 s, many round trips.
const MAX_HANDSHAKES_BY_ADDRESS: usize = 8;
/// Maximum pairings at a time.
const MAX_PAIRINGS: usize = 4;
/// Above this number in progress, addresses must be validated first (RFC 9000, section 8.1).
const RETRY_ABOVE: usize = 4;
/// Handshake timeout: far more than a network with 50 ms and some loss needs.
const HANDSHAKE_WITHIN: Duration = Duration::from_secs(4);
/// Buffer for a few poses; when more wait for the network, the oldest are dropped. [bytes]
const POSES_WAITING: usize = 1024;
/// A vehicle needs one; unknown peers must not exhaust the memory.
const MAX_CONNECTIONS: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    fn check(address: &str, expected: Congestion) {
        assert_eq!(Congestion::Auto.toward(address.parse().unwrap()), expected, "{address}");
    }

    #[test]
    fn private_addresses_use_lan_and_public_ones_bbr() {
        check("127.0.0.1", Congestion::Lan);
        check("192.168.10.7", Congestion::Lan);
        check("::ffff:10.0.0.1", Congestion::Lan);
        check("fe80::1", Congestion::Lan);
        check("8.8.8.8", Congestion::Bbr);
        check("2001:db8::1", Congestion::Bbr);
        let lab = "127.0.0.1".parse().unwrap();
        assert_eq!(Congestion::Bbr.toward(lab), Congestion::Bbr);
    }
}
