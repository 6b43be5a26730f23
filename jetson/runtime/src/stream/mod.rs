//! QUIC connection to the render server: receives poses, events and images, and sends telemetry.
//!
//! ```text
//! datagrams                     ── Pose 100 Hz, newest wins ──▶ control loop
//! control stream (bi, ordered)  ── Event, Camera, Clock ──▶ control loop
//!                               ◀─ Hello, Clock, Telemetry 10 Hz, Event ── Outbox
//! one uni stream per image      ── header, slices, trailer ──▶ Mailbox, newest wins ──▶ images
//! one uni stream per reading    ── header, records ──▶ Readings, newest wins ──▶ images, control loop
//! ```
//! Runs on tokio. After an outage (3 s of silence, a restarted server) the runtime reconnects, with
//! retries during the whole flight. Events are numbered and acknowledged in both directions: after an
//! outage, missing events are sent again, and each event is delivered once. Both sides present a
//! certificate and check the SHA-256 of the other's.

mod mailbox;
mod outbox;
mod pair;
mod readings;
mod receive;
mod session;
#[cfg(test)]
mod tests;

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use vizflyt_process::lock;

use quinn::{AckFrequencyConfig, ClientConfig, Endpoint, EndpointConfig, TransportConfig, VarInt};
use socket2::{Domain, Protocol, Socket, Type};
use vizflyt_protocol::messages::{
    ArenaInfo, CameraInfo, ClockState, Event, Name, PoseSample, Purpose, ReceivedEvents, Text,
};
use vizflyt_protocol::packet::feed::FeedKey;
use vizflyt_protocol::sensor::SensorInfo;
use vizflyt_protocol::time::{Host, HostTime, OffsetFilter, Server, ServerTime};
use vizflyt_trust::tls::Pin;
use vizflyt_trust::{ALPN, Fingerprint, Identity, random_instance_id};

pub use mailbox::{Arrival, DecodeStep, Fates, Mailbox, Ticket, Whole};
pub use outbox::Outbox;
pub use pair::{NowPaired, pair};
pub use readings::{NewestReadings, Reading, Readings};

/// Settings of the connection to the server.
#[derive(Clone, Debug)]
pub struct StreamSettings {
    /// Address of the server.
    pub server: SocketAddr,
    /// SHA-256 of the server's certificate (DER).
    pub fingerprint: Fingerprint,
    /// Key and certificate of this computer.
    pub identity: Identity,
    /// Name of the vehicle in the localization system.
    pub vehicle: Name,
    /// Flying or watching.
    pub purpose: Purpose,
    /// Name and version of this program, for the server's page and log.
    pub program: Text,
}

/// An event of the server connection, for the control loop.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // Why: handed on by value at once, never stored.
pub enum StreamEvent {
    /// The server accepted the connection.
    Welcome(Box<ArenaInfo>),
    /// Address and key of the server's pose feed for the guardian, which bypasses the runtime.
    Feed(SocketAddr, FeedKey),
    /// The connection failed permanently, for the reason in this sentence; no retry follows.
    Refused(String),
    /// The connection failed or ended; a retry follows.
    Down(String),
    /// A pose, and its stamp on this computer's clock.
    Pose(PoseSample, HostTime),
    /// An event of the server.
    Event(Event),
    /// New settings of the camera with this index.
    Camera(u8, Box<CameraInfo>),
    /// New settings of the sensor with this index.
    Sensor(u8, Box<SensorInfo>),
}

/// Relation between the server's clock and this computer's clock, shared by all threads.
#[derive(Clone, Debug, Default)]
pub struct ServerClock {
    filter: Arc<Mutex<OffsetFilter<Host, Server>>>,
    is_same: bool,
}

impl ServerClock {
    /// Returns the relation to a server with the same clock: stamps are not converted.
    pub fn same() -> Self {
        Self { is_same: true, ..Self::default() }
    }

    fn filter(&self) -> std::sync::MutexGuard<'_, OffsetFilter<Host, Server>> {
        lock(&self.filter)
    }

    /// Returns a server stamp on this computer's clock; `None` before the first exchange.
    pub fn to_host(&self, stamp: ServerTime) -> Option<HostTime> {
        if self.is_same {
            return Some(HostTime::from_ns(stamp.as_ns()));
        }
        self.filter().to_local(stamp)
    }

    /// Returns a stamp of this computer on the server's clock; zero before the first exchange.
    pub fn to_server(&self, stamp: HostTime) -> ServerTime {
        if self.is_same {
            return ServerTime::from_ns(stamp.as_ns());
        }
        self.filter().to_remote(stamp).unwrap_or(ServerTime::ZERO)
    }

    /// Returns the relation at `now`; `None` before the first exchange.
    pub fn state(&self, now: HostTime) -> Option<ClockState> {
        let filter = self.filter();
        let (drift_ppm, drift_bound_ppm) = filter.drift_ppm()?;
        Some(ClockState {
            offset_ns: filter.offset_ns(now)?,
            error_bound_ms: (filter.error_bound_ns(now)? as f64 * 1e-6) as f32,
            drift_ppm: drift_ppm as f32,
            drift_bound_ppm: drift_bound_ppm as f32,
            steps: u32::try_from(filter.steps()).unwrap_or(u32::MAX),
        })
    }

    /// Returns the bound of the error of [`Self::to_host`] at `now`; `None` before the first
    /// exchange. [ns]
    pub fn error_bound_ns(&self, now: HostTime) -> Option<u64> {
        self.filter().error_bound_ns(now)
    }

    fn update(&self, sent: HostTime, answered: ServerTime, received: HostTime) {
        self.filter().update(sent, answered, received);
    }

    /// Discards all samples: a new connection may lead to a server with another clock.
    fn reset(&self) {
        *self.filter() = OffsetFilter::default();
    }
}

/// State shared by a session and the rest of the runtime.
#[derive(Clone, Debug)]
pub struct Shared {
    pub clock: ServerClock,
    /// Destination of images.
    pub mailbox: Arc<Mailbox>,
    /// Destination of readings of other sensors.
    pub readings: Arc<Readings>,
}

/// Size of the socket buffers. The kernel's default of 200 KB loses packets of large images (measured at
/// 600 KB: 4000 lost packets instead of 0, p50 2.7 ms instead of 1.8 ms). [bytes]
const SOCKET_BUFFER: usize = 4 << 20;
/// Receive window of one stream; the largest image fits without waiting for credit. [bytes]
const STREAM_WINDOW: u32 = 4 << 20;
/// Maximum number of concurrent image streams; the server limits itself to fewer.
const IMAGES_AT_ONCE: u32 = 64;
/// Maximum unread data of all streams, which bounds the memory that a hostile server can use. [bytes]
const RECEIVE_WINDOW: u32 = 32 << 20;
/// Buffer for received poses, enough for a few; when full, the oldest are dropped. [bytes]
const POSES_WAITING: usize = 4096;
/// Delay before reconnecting.
const RETRY: Duration = Duration::from_millis(200);

/// Runs the connection to the server until `outbox` is closed and all its events are acknowledged, or
/// the caller drops the task. `handle` returns whether it accepted the event. If not, the runtime
/// reconnects, and the server sends the event again.
pub async fn run(
    settings: StreamSettings,
    shared: Shared,
    outbox: Arc<Outbox>,
    handle: impl Fn(StreamEvent) -> bool + Send + Sync,
) {
    run_over(endpoint, settings, shared, outbox, handle).await;
}

/// Same as [`run`], with a new endpoint from `open` for each connection, for example over a simulated
/// network.
pub async fn run_over(
    open: impl Fn(SocketAddr) -> std::io::Result<Endpoint>,
    settings: StreamSettings,
    shared: Shared,
    outbox: Arc<Outbox>,
    handle: impl Fn(StreamEvent) -> bool + Send + Sync,
) {
    let mut past =
        Past { boot: random_instance_id(), received: ReceivedEvents::default(), welcomed: false };
    let mut last = String::new();
    loop {
        let error = match connect(&open, &settings).await {
            Ok((endpoint, connection)) => {
                let with = session::SessionContext {
                    settings: &settings,
                    shared: &shared,
                    outbox: &outbox,
                };
                let error = session::run(&with, &mut past, &connection, &handle).await;
                connection.close(VarInt::from_u32(0), b"bye");
                // Waits until the close is sent, so that the server frees the vehicle at once.
                let _ = tokio::time::timeout(RETRY, endpoint.wait_idle()).await;
                error
            }
            Err(error) => error,
        };
        match error {
            SessionEnd::Done => return,
            SessionEnd::Final(why) => {
                handle(StreamEvent::Refused(why));
                return;
            }
            SessionEnd::Retry(why) => {
                // Reports each cause once, not five times a second.
                if why != last || std::mem::take(&mut past.welcomed) {
                    handle(StreamEvent::Down(why.clone()));
                    last = why;
                }
            }
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// State that outlives a connection.
#[derive(Clone, Copy, Debug)]
struct Past {
    /// Random id of this run, which distinguishes its events from those of other runs.
    boot: u64,
    /// Received events of the server.
    received: ReceivedEvents,
    /// Whether the server has sent a welcome since the last reported outage.
    welcomed: bool,
}

/// Reason for the end of a session.
#[derive(Debug)]
enum SessionEnd {
    /// A retry may succeed.
    Retry(String),
    /// A retry cannot succeed.
    Final(String),
    /// Everything has been sent and acknowledged.
    Done,
}

async fn connect(
    open: &impl Fn(SocketAddr) -> std::io::Result<Endpoint>,
    settings: &StreamSettings,
) -> Result<(Endpoint, quinn::Connection), SessionEnd> {
    let retry = |what: &str, error: &dyn std::fmt::Display| {
        SessionEnd::Retry(format!("server {}: {what}: {error}", settings.server))
    };
    let pin = Pin::to(settings.fingerprint);
    let endpoint = open(settings.server).map_err(|error| retry("socket", &error))?;
    let config = client_config(&pin, &settings.identity)
        .map_err(|error| SessionEnd::Final(format!("TLS set-up: {error}")))?;
    let connecting = endpoint
        .connect_with(config, settings.server, "vizflyt")
        .map_err(|error| retry("address", &error))?;
    match connecting.await {
        Ok(connection) => Ok((endpoint, connection)),
        Err(error) => Err(match pin.mismatch() {
            Some(found) => SessionEnd::Final(format!(
                "server {} has another certificate than the server this computer is paired with: {found}; \
                 if this server is yours, pair again",
                settings.server
            )),
            None => retry("no connection", &error),
        }),
    }
}

fn endpoint(server: SocketAddr) -> std::io::Result<Endpoint> {
    let local: SocketAddr = match server {
        SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
        SocketAddr::V6(_) => ([0_u16; 8], 0).into(),
    };
    let socket = Socket::new(Domain::for_address(local), Type::DGRAM, Some(Protocol::UDP))?;
    // Best effort: the kernel limits the sizes to net.core.rmem_max and wmem_max.
    let _ = socket.set_recv_buffer_size(SOCKET_BUFFER);
    let _ = socket.set_send_buffer_size(SOCKET_BUFFER);
    socket.bind(&local.into())?;
    Endpoint::new(EndpointConfig::default(), None, socket.into(), Arc::new(quinn::TokioRuntime))
}

fn client_config(pin: &Pin, identity: &Identity) -> Result<ClientConfig, rustls::Error> {
    let tls = pin.client_config(identity, ALPN)?;
    let crypto = quinn::crypto::rustls::QuicClientConfig::try_from(tls)
        .map_err(|error| rustls::Error::General(error.to_string()))?;
    let mut config = ClientConfig::new(Arc::new(crypto));
    config.transport_config(Arc::new(transport()));
    Ok(config)
}

/// Returns transport settings, tuned by measurements on loopback and on an impaired link.
fn transport() -> TransportConfig {
    let mut acks = AckFrequencyConfig::default();
    acks.ack_eliciting_threshold(VarInt::from_u32(10));
    acks.max_ack_delay(Some(Duration::from_millis(2)));
    let mut transport = TransportConfig::default();
    transport
        .max_concurrent_uni_streams(VarInt::from_u32(IMAGES_AT_ONCE))
        .max_concurrent_bidi_streams(VarInt::from_u32(0))
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW))
        .receive_window(VarInt::from_u32(RECEIVE_WINDOW))
        .datagram_receive_buffer_size(Some(POSES_WAITING))
        .send_window(2 << 20)
        .ack_frequency_config(Some(acks))
        .keep_alive_interval(Some(Duration::from_secs(1)))
        .max_idle_timeout(Some(VarInt::from_u32(5_000).into()));
    transport
}
