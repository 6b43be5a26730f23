//! One connection: handshake, then messages in both directions and images, until it fails.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::time::Duration;

use quinn::{Connection, ConnectionError, RecvStream, SendStream, VarInt};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};
use vizflyt_protocol::messages::{
    ClockRequest, Datagram, Hello, ToRuntime, ToServer, Welcome, close,
};
use vizflyt_protocol::packet::feed::{FEED_LABEL, FeedKey};
use vizflyt_protocol::packet::framing::{Deframer, FramingError, MAX_FRAMED, decode_body, encode};
use vizflyt_protocol::packet::{PeerRole, Preamble};
use vizflyt_protocol::time::ServerTime;
use zerocopy::IntoBytes;

use super::{Outbox, Past, SessionEnd, Shared, StreamEvent, StreamSettings, receive};
use crate::clock;

/// Silence of the server after which the runtime reconnects. Longer than a blackout of 2 s: an existing
/// connection delivers the newest image 15 ms after its end, whereas a new one would still wait for
/// timeouts of its handshake. A restarted server reports the restart itself.
const SILENCE: Duration = Duration::from_secs(3);
/// Period of clock requests at the start and while the server is silent.
const CLOCK_FAST: Duration = Duration::from_millis(250);
/// Period of clock requests at other times.
const CLOCK_SLOW: Duration = Duration::from_secs(1);
/// Number of fast requests at the start, which fill the filter's window.
const CLOCK_FIRST: u32 = 8;

/// Context of a session.
pub(super) struct SessionContext<'a> {
    pub(super) settings: &'a StreamSettings,
    pub(super) shared: &'a Shared,
    pub(super) outbox: &'a Outbox,
}

/// Runs the session until the connection fails; returns the reason.
pub(super) async fn run(
    with: &SessionContext<'_>,
    past: &mut Past,
    connection: &Connection,
    handle: &(impl Fn(StreamEvent) -> bool + Send + Sync),
) -> SessionEnd {
    with.shared.clock.reset();
    let end = match run_inner(with, past, connection, handle).await {
        Ok(never) => match never {},
        Err(end) => end,
    };
    // The server's close reason is more precise than the error of the first failed call.
    match (connection.close_reason(), end) {
        (Some(ConnectionError::ApplicationClosed(frame)), _)
            if frame.error_code == VarInt::from_u32(close::UNPAIRED) =>
        {
            SessionEnd::Final(String::from_utf8_lossy(&frame.reason).into_owned())
        }
        (Some(error), SessionEnd::Retry(_)) => lost(error),
        (_, end) => end,
    }
}

fn lost(error: impl std::fmt::Display) -> SessionEnd {
    SessionEnd::Retry(format!("connection to the server lost: {error}"))
}

async fn run_inner<T: Fn(StreamEvent) -> bool>(
    with: &SessionContext<'_>,
    past: &mut Past,
    connection: &Connection,
    handle: &T,
) -> Result<Infallible, SessionEnd> {
    let (mut send, mut receive) = connection.open_bi().await.map_err(lost)?;
    send.write_all(Preamble::of(PeerRole::Runtime).as_bytes()).await.map_err(lost)?;
    let hello = Hello {
        vehicle: with.settings.vehicle.clone(),
        purpose: with.settings.purpose,
        program: with.settings.program.clone(),
        boot: past.boot,
        received_events: past.received,
    };
    write(&mut send, &ToServer::Hello(hello)).await?;
    check_preamble(&mut receive).await?;

    receive::start(connection, with.shared);
    let newest_pose = ServerTime::ZERO;
    let mut receiver = Receiver { with, past, connection, handle, server: None, newest_pose };
    let mut deframer = Box::new(Deframer::default());
    let mut chunk = vec![0; MAX_FRAMED];
    let mut ticks = interval(CLOCK_FAST);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut received_at, mut asked_at, mut asked_count) = (Instant::now(), Instant::now(), 0);
    loop {
        tokio::select! {
            read = receive.read(&mut chunk) => {
                let len = read.map_err(lost)?.ok_or_else(|| lost("the server closed it"))?;
                received_at = Instant::now();
                let (mut bytes, before) = (&chunk[..len], receiver.past.received);
                while !bytes.is_empty() {
                    bytes = &bytes[deframer.push(bytes)..];
                    while let Some(message) = deframer.next::<ToRuntime>() {
                        receiver.take(message)?;
                    }
                }
                if receiver.past.received != before {
                    write(&mut send, &ToServer::EventsReceived(receiver.past.received.seq)).await?;
                }
            }
            datagram = connection.read_datagram() => {
                let datagram = datagram.map_err(lost)?;
                received_at = Instant::now();
                receiver.take_datagram(&datagram);
            }
            message = with.outbox.next(), if receiver.server.is_some() => match message {
                Some(message) => write(&mut send, &message).await?,
                None => return Err(SessionEnd::Done),
            },
            _ = ticks.tick() => {
                if received_at.elapsed() > SILENCE {
                    return Err(SessionEnd::Retry("the server has been silent for 3 s".into()));
                }
                let silent = received_at.elapsed() >= CLOCK_FAST;
                if asked_count < CLOCK_FIRST || silent || asked_at.elapsed() >= CLOCK_SLOW {
                    (asked_at, asked_count) = (Instant::now(), asked_count + 1);
                    write(&mut send, &ToServer::Clock(ClockRequest { sent: clock::now() })).await?;
                }
            }
        }
    }
}

async fn check_preamble(receive: &mut RecvStream) -> Result<(), SessionEnd> {
    let mut preamble = [0; Preamble::SIZE];
    timeout(SILENCE, receive.read_exact(&mut preamble))
        .await
        .map_err(|_| SessionEnd::Retry("the server does not answer".into()))?
        .map_err(lost)?;
    match Preamble::check(&preamble, PeerRole::Runtime) {
        Ok(PeerRole::Server) => Ok(()),
        Ok(other) => Err(SessionEnd::Final(format!("the other side is a {}", other.name()))),
        Err(error) => Err(SessionEnd::Final(error.to_string())),
    }
}

/// Handles the server's messages.
struct Receiver<'a, T> {
    with: &'a SessionContext<'a>,
    past: &'a mut Past,
    connection: &'a Connection,
    handle: &'a T,
    /// The server's `boot`, after its welcome.
    server: Option<u64>,
    newest_pose: ServerTime,
}

impl<T: Fn(StreamEvent) -> bool> Receiver<'_, T> {
    fn take(&mut self, message: Result<ToRuntime, FramingError>) -> Result<(), SessionEnd> {
        match message {
            Ok(ToRuntime::Welcome(Welcome { boot, received_events, arena, feed_port })) => {
                self.offer_feed(feed_port)?;
                (self.server, self.past.welcomed) = (Some(boot), true);
                self.with.outbox.resume(received_events.of(self.past.boot));
                self.hand(StreamEvent::Welcome(Box::new(arena)))?;
            }
            // Retry, because another runtime may be about to leave.
            Ok(ToRuntime::Refused(why)) => {
                return Err(SessionEnd::Retry(format!("the server refuses: {why}")));
            }
            Ok(ToRuntime::Clock(reply)) => {
                self.with.shared.clock.update(reply.sent, reply.answered, clock::now());
            }
            Ok(ToRuntime::Event { seq, event }) => {
                let Some(boot) = self.server else { return Err(lost("an event before Welcome")) };
                let mut received = self.past.received;
                if received.receive(boot, seq) {
                    self.hand(StreamEvent::Event(event))?;
                    self.past.received = received;
                }
            }
            Ok(ToRuntime::EventsReceived(seq)) => self.with.outbox.acknowledged(seq),
            Ok(ToRuntime::Camera { index, camera }) => {
                self.hand(StreamEvent::Camera(index, Box::new(camera)))?;
            }
            Ok(ToRuntime::Sensor { index, sensor }) => {
                self.hand(StreamEvent::Sensor(index, Box::new(sensor)))?;
            }
            Err(error @ FramingError::Body(_)) => tracing::warn!("server: {error}"),
            Err(error @ FramingError::TooLong(_)) => return Err(lost(error)),
        }
        Ok(())
    }

    /// Reports address and key of the pose feed for the guardian.
    fn offer_feed(&self, port: u16) -> Result<(), SessionEnd> {
        let mut key = FeedKey::default();
        if port == 0 || self.connection.export_keying_material(&mut key, FEED_LABEL, b"").is_err() {
            return Ok(());
        }
        let server = SocketAddr::new(self.connection.remote_address().ip(), port);
        self.hand(StreamEvent::Feed(server, key))
    }

    /// Passes an event to the control loop. If it is not accepted, the session ends, and the server sends
    /// the event again on the next connection.
    fn hand(&self, event: StreamEvent) -> Result<(), SessionEnd> {
        if (self.handle)(event) {
            Ok(())
        } else {
            Err(SessionEnd::Retry("this runtime is too busy to accept events".into()))
        }
    }

    /// Passes on a pose; drops it if a newer one has arrived before it.
    fn take_datagram(&mut self, bytes: &[u8]) {
        let Ok(Datagram::Pose(sample)) = decode_body(bytes) else {
            return tracing::debug!("server: a datagram of {} bytes does not decode", bytes.len());
        };
        if self.server.is_none() || sample.stamp <= self.newest_pose || !sample.is_valid() {
            return;
        }
        // Before the first clock exchange, the stamp cannot be converted.
        if let Some(stamp) = self.with.shared.clock.to_host(sample.stamp) {
            self.newest_pose = sample.stamp;
            (self.handle)(StreamEvent::Pose(sample, stamp));
        }
    }
}

async fn write(send: &mut SendStream, message: &ToServer) -> Result<(), SessionEnd> {
    let mut buffer = [0; MAX_FRAMED];
    send.write_all(encode(message, &mut buffer)).await.map_err(lost)
}
