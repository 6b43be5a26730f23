//! One connection: handshake, then messages both ways and images, until it fails.

use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, ConnectionError, RecvStream, SendStream, VarInt};
use tokio::sync::{Semaphore, mpsc};
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};
use vizflyt_protocol::messages::{ClockRequest, Hello, ToRuntime, ToServer, bounded, close};
use vizflyt_protocol::packet::framing::{Deframer, FramingError, MAX_FRAMED, encode};
use vizflyt_protocol::packet::{ImageHeader, Party, Preamble};
use zerocopy::IntoBytes;

use crate::clock;

use super::{IMAGES_AT_ONCE, ReceivedImage, SessionEnd, Shared, StreamEvent, StreamSettings};

/// Nothing from the server for this long: connect anew.
const SILENCE: Duration = Duration::from_secs(1);
/// The clock is asked this often: four times a second at the start and when the server is
/// silent, else once.
const CLOCK_FAST: Duration = Duration::from_millis(250);
const CLOCK_SLOW: Duration = Duration::from_secs(1);
/// Requests at the start that fill the filter's window.
const CLOCK_FIRST: u32 = 8;
/// An image that has not come whole after this long is given up; it would be stale.
const IMAGE_WITHIN: Duration = Duration::from_millis(500);

/// Converses until the connection fails; returns why.
pub(super) async fn converse(
    settings: &StreamSettings,
    shared: &Shared,
    connection: &Connection,
    outbox: &mut mpsc::Receiver<ToServer>,
    tell: &(impl Fn(StreamEvent) + Send + Sync),
) -> SessionEnd {
    shared.clock.reset();
    let end = match converse_inner(settings, shared, connection, outbox, tell).await {
        Ok(never) => match never {},
        Err(end) => end,
    };
    // What the server said on closing tells more than which of our calls failed first.
    match connection.close_reason() {
        Some(ConnectionError::ApplicationClosed(said))
            if said.error_code == VarInt::from_u32(close::UNPAIRED) =>
        {
            SessionEnd::Final(String::from_utf8_lossy(&said.reason).into_owned())
        }
        _ => end,
    }
}

fn lost(error: impl std::fmt::Display) -> SessionEnd {
    SessionEnd::Retry(format!("connection to the server lost: {error}"))
}

async fn converse_inner(
    settings: &StreamSettings,
    shared: &Shared,
    connection: &Connection,
    outbox: &mut mpsc::Receiver<ToServer>,
    tell: &(impl Fn(StreamEvent) + Send + Sync),
) -> Result<std::convert::Infallible, SessionEnd> {
    let (mut send, mut receive) = connection.open_bi().await.map_err(lost)?;
    send.write_all(Preamble::of(Party::Runtime).as_bytes()).await.map_err(lost)?;
    let hello = Hello {
        vehicle: settings.vehicle.clone(),
        program: bounded(concat!("vizflyt-runtime ", env!("CARGO_PKG_VERSION"))),
    };
    write(&mut send, &ToServer::Hello(hello)).await?;
    let mut preamble = [0; Preamble::SIZE];
    timeout(2 * SILENCE, receive.read_exact(&mut preamble))
        .await
        .map_err(|_| SessionEnd::Retry("the server does not answer".into()))?
        .map_err(lost)?;
    match Preamble::check(&preamble, Party::Runtime) {
        Ok(Party::Server) => {}
        Ok(other) => {
            return Err(SessionEnd::Final(format!("the other side is a {}", other.name())));
        }
        Err(error) => return Err(SessionEnd::Final(error.to_string())),
    }

    let images = Arc::new(Semaphore::new(IMAGES_AT_ONCE as usize));
    let mut deframer = Box::new(Deframer::default());
    let mut chunk = vec![0; MAX_FRAMED];
    let mut clock = interval(CLOCK_FAST);
    clock.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut heard, mut asked, mut asked_count) = (Instant::now(), Instant::now(), 0);
    loop {
        tokio::select! {
            read = receive.read(&mut chunk) => {
                let len = read.map_err(lost)?.ok_or_else(|| lost("the server closed it"))?;
                heard = Instant::now();
                let mut bytes = &chunk[..len];
                while !bytes.is_empty() {
                    bytes = &bytes[deframer.push(bytes)..];
                    while let Some(message) = deframer.next::<ToRuntime>() {
                        take(message, shared, tell)?;
                    }
                }
            }
            message = outbox.recv() => match message {
                Some(message) => write(&mut send, &message).await?,
                // The flight is over.
                None => return Err(SessionEnd::Final("done".into())),
            },
            stream = connection.accept_uni() => {
                let stream = stream.map_err(lost)?;
                // The transport bounds concurrent streams; this bounds what we buffer of them.
                if let Ok(permit) = Arc::clone(&images).try_acquire_owned() {
                    let shared = shared.clone();
                    tokio::spawn(async move {
                        receive_image(stream, &shared).await;
                        drop(permit);
                    });
                }
            }
            _ = clock.tick() => {
                if heard.elapsed() > SILENCE {
                    return Err(SessionEnd::Retry("the server has been silent for 1 s".into()));
                }
                let silent = heard.elapsed() >= SILENCE / 4;
                if asked_count < CLOCK_FIRST || silent || asked.elapsed() >= CLOCK_SLOW {
                    (asked, asked_count) = (Instant::now(), asked_count + 1);
                    write(&mut send, &ToServer::Clock(ClockRequest { sent: clock::now() })).await?;
                }
            }
        }
    }
}

/// Acts on one message.
fn take(
    message: Result<ToRuntime, FramingError>,
    shared: &Shared,
    tell: &impl Fn(StreamEvent),
) -> Result<(), SessionEnd> {
    match message {
        Ok(ToRuntime::Welcome(arena)) => tell(StreamEvent::Welcome(Box::new(arena))),
        // Another runtime may be leaving: try again.
        Ok(ToRuntime::Refused(why)) => {
            return Err(SessionEnd::Retry(format!("the server refuses: {why}")));
        }
        Ok(ToRuntime::Clock(reply)) => {
            shared.clock.update(reply.sent, reply.answered, clock::now());
        }
        Ok(ToRuntime::Pose(sample)) => {
            // Before the first clock exchange a pose cannot be placed in time.
            if let Some(stamp) = shared.clock.to_host(sample.stamp) {
                tell(StreamEvent::Pose(sample, stamp));
            }
        }
        Ok(ToRuntime::Event(event)) => tell(StreamEvent::Event(event)),
        Ok(ToRuntime::Camera { index, camera }) => {
            tell(StreamEvent::Camera(index, Box::new(camera)));
        }
        Err(error @ FramingError::Body(_)) => tracing::warn!("server: {error}"),
        Err(error @ FramingError::TooLong(_)) => return Err(lost(error)),
    }
    Ok(())
}

async fn write(send: &mut SendStream, message: &ToServer) -> Result<(), SessionEnd> {
    let mut buffer = [0; MAX_FRAMED];
    send.write_all(encode(message, &mut buffer)).await.map_err(lost)
}

/// Receives one image into the mailbox. One that is cut off, late or nonsense is dropped: the
/// next one comes in a moment.
async fn receive_image(mut stream: RecvStream, shared: &Shared) {
    let image = async {
        let mut bytes = [0; ImageHeader::SIZE];
        stream.read_exact(&mut bytes).await.ok()?;
        let first = clock::now();
        let (header, _) = ImageHeader::parse(&bytes)
            .inspect_err(|error| tracing::debug!("image dropped: {error}"))
            .ok()?;
        // Bounded by `parse`.
        let mut payload = vec![0; header.payload_len.get() as usize];
        stream.read_exact(&mut payload).await.ok()?;
        Some((header, payload, first))
    };
    let Ok(Some((header, payload, first))) = timeout(IMAGE_WITHIN, image).await else { return };
    let received = clock::now();
    let Some(pose) = shared.clock.to_host(header.pose_stamp()) else { return };
    shared.mailbox.offer(ReceivedImage { header, payload, pose, first, received });
}
