//! One runtime's connection, from its first byte to its last.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, ConnectionError, RecvStream, SendStream, VarInt};
use tokio::sync::mpsc;
use tokio::time::timeout;
use tracing::{debug, info, warn};
use vizflyt_protocol::messages::{ClockReply, ClockRequest, Hello, ToRuntime, ToServer, bounded};
use vizflyt_protocol::packet::framing::{Deframer, FramingError, MAX_FRAMED, encode};
use vizflyt_protocol::packet::{Party, Preamble};
use vizflyt_protocol::time::ServerTime;
use zerocopy::IntoBytes;

use super::{END, FOREIGN, REFUSED, REPLACED, SLOW, images};
use crate::cameras::CameraSet;
use crate::clock;
use crate::events::Origin;
use crate::hub::{Hub, Seat};

/// Why a session ends: the close code and the reason in words.
type Ending = (VarInt, String);

/// Speaks with one runtime until either side ends it.
pub(super) async fn run(hub: Arc<Hub>, connection: Connection) {
    let address = connection.remote_address();
    let (code, reason) = tokio::select! {
        ending = talk(&hub, &connection) => ending,
        () = hub.stop.wait() => (END, "the server ends".to_owned()),
    };
    // What the other side said on closing tells more than which of our calls failed first.
    let reason = connection.close_reason().map_or(reason, |error| why(&error));
    info!("{address}: session ends: {reason}");
    // Why: RFC 9000 lets a reason be of any length, but it must fit a packet.
    let cut: String = reason.chars().take(200).collect();
    connection.close(code, cut.as_bytes());
}

async fn talk(hub: &Arc<Hub>, connection: &Connection) -> Ending {
    let opened = timeout(PATIENCE, async {
        let (send, mut recv) = connection.accept_bi().await.map_err(|error| gone(&error))?;
        let mut preamble = [0; Preamble::SIZE];
        recv.read_exact(&mut preamble).await.map_err(|error| gone(&error))?;
        Ok::<_, Ending>((send, recv, preamble))
    });
    let (mut send, recv, preamble) = match opened.await {
        Ok(Ok(opened)) => opened,
        Ok(Err(ending)) => return ending,
        Err(_) => return (FOREIGN, "nothing was said for 5 s".to_owned()),
    };
    // Ours goes out even to another version: its layout never changes, so that both can tell.
    if let Err(error) = send.write_all(Preamble::of(Party::Server).as_bytes()).await {
        return gone(&error);
    }
    if let Err(error) = Preamble::check(&preamble, Party::Server) {
        let reason = error.to_string();
        warn!("{}: {reason}", connection.remote_address());
        let _ = send.finish();
        return linger(connection, (FOREIGN, reason)).await;
    }
    let mut incoming = Incoming::new(recv);
    let hello = match timeout(PATIENCE, incoming.next()).await {
        Ok(Ok(ToServer::Hello(hello))) => hello,
        Ok(Ok(_)) => return (FOREIGN, "the first message was not Hello".to_owned()),
        Ok(Err(ending)) => return ending,
        Err(_) => return (FOREIGN, "no Hello came for 5 s".to_owned()),
    };
    match hub.sit(&hello, connection.remote_address()) {
        Ok(seat) => Box::pin(fly(hub, connection, &hello, &seat, send, incoming)).await,
        Err(reason) => {
            warn!("{}: refused: {reason}", connection.remote_address());
            let mut out = Outbound { send, buffer: [0; MAX_FRAMED] };
            let refusal = ToRuntime::Refused(bounded(&reason));
            if let Err(ending) = out.write(&refusal).await {
                return ending;
            }
            let _ = out.send.finish();
            linger(connection, (REFUSED, reason)).await
        }
    }
}

fn why(error: &ConnectionError) -> String {
    match error {
        ConnectionError::ApplicationClosed(close) if close.reason.is_empty() => {
            "closed by the runtime".to_owned()
        }
        ConnectionError::ApplicationClosed(close) => {
            format!("closed by the runtime: {}", String::from_utf8_lossy(&close.reason))
        }
        ConnectionError::TimedOut => "nothing came for 5 s".to_owned(),
        other => other.to_string(),
    }
}

/// Gives the last words time to arrive: closing at once would discard them.
async fn linger(connection: &Connection, ending: Ending) -> Ending {
    let _ = timeout(Duration::from_secs(2), connection.closed()).await;
    ending
}

async fn fly(
    hub: &Arc<Hub>,
    connection: &Connection,
    hello: &Hello,
    seat: &Seat,
    send: SendStream,
    incoming: Incoming,
) -> Ending {
    let address = connection.remote_address();
    let again = if seat.resumed { ", and resumes its flight" } else { "" };
    info!("{address}: {} flies '{}'{again}", hello.program, hello.vehicle);
    hub.note(&format!("{} at {address} connected{again}", hello.program));
    // Control goes out before images.
    let _ = send.set_priority(1);
    let (clock_sender, clock_requests) = mpsc::channel(CLOCK_QUEUE);
    let outlet = images::Lane::open(hub.clone(), connection.clone(), seat.info.id);
    let ending = tokio::select! {
        ending = down(hub, seat, send, clock_requests) => ending,
        ending = up(hub, seat, incoming, clock_sender) => ending,
        ending = outlet.run() => ending,
        () = seat.evicted() => {
            (REPLACED, "a newer runtime took over after a second of silence".to_owned())
        }
        error = connection.closed() => gone(&error),
    };
    let reason = connection.close_reason().map_or_else(|| ending.1.clone(), |error| why(&error));
    hub.note(&format!("the runtime at {address} is gone: {reason}"));
    ending
}

/// Server to runtime: events first, then changed cameras, clock replies, and the newest pose.
async fn down(
    hub: &Hub,
    seat: &Seat,
    send: SendStream,
    mut clock_requests: mpsc::Receiver<ClockRequest>,
) -> Ending {
    let mut out = Outbound { send, buffer: [0; MAX_FRAMED] };
    let mut poses = hub.pose.subscribe();
    let mut log = hub.events.subscribe();
    log.mark_changed();
    let mut cursor = seat.first_event;
    let mut cameras = hub.cameras.subscribe();
    let mut told = cameras.borrow_and_update().clone();
    if let Err(ending) = out.write(&ToRuntime::Welcome(hub.welcome(&told))).await {
        return ending;
    }
    let mut last_pose = ServerTime::ZERO;
    loop {
        let written = tokio::select! {
            biased;
            _ = log.changed() => {
                log.mark_unchanged();
                tell(hub, &mut out, &mut cursor).await
            }
            _ = cameras.changed() => {
                let newest = cameras.borrow_and_update().clone();
                let before = std::mem::replace(&mut told, newest);
                tell_cameras(&mut out, &before, &told).await
            }
            Some(request) = clock_requests.recv() => {
                let reply = ClockReply { sent: request.sent, answered: clock::now() };
                out.write(&ToRuntime::Clock(reply)).await
            }
            _ = poses.changed() => {
                let newest = *poses.borrow_and_update();
                match newest {
                    Some(pose) if pose.stamp.seconds_since(last_pose) >= POSE_EVERY_S => {
                        last_pose = pose.stamp;
                        out.write(&ToRuntime::Pose(pose)).await
                    }
                    _ => Ok(()),
                }
            }
        };
        if let Err(ending) = written {
            return ending;
        }
    }
}

async fn tell(hub: &Hub, out: &mut Outbound, cursor: &mut u64) -> Result<(), Ending> {
    let entries = hub.events.read(cursor).map_err(|lagged| (SLOW, lagged.to_string()))?;
    for entry in entries {
        if entry.origin == Origin::Server {
            out.write(&ToRuntime::Event(entry.event)).await?;
        }
    }
    Ok(())
}

async fn tell_cameras(
    out: &mut Outbound,
    before: &CameraSet,
    now: &CameraSet,
) -> Result<(), Ending> {
    for (index, camera) in now.infos.iter().enumerate() {
        if before.infos.get(index) != Some(camera) {
            let camera = camera.clone();
            out.write(&ToRuntime::Camera { index: index as u8, camera }).await?;
        }
    }
    Ok(())
}

/// Runtime to server.
async fn up(
    hub: &Hub,
    seat: &Seat,
    mut incoming: Incoming,
    clock_requests: mpsc::Sender<ClockRequest>,
) -> Ending {
    loop {
        let message = match incoming.next().await {
            Ok(message) => message,
            Err(ending) => return ending,
        };
        seat.heard(clock::now());
        match message {
            // A full queue means that replies cannot leave; a late reply would mislead anyway.
            ToServer::Clock(request) => drop(clock_requests.try_send(request)),
            ToServer::Telemetry(report) => {
                hub.report(report);
            }
            ToServer::Event(event) => {
                hub.log(Origin::Page, event);
            }
            ToServer::Hello(_) => debug!("a second Hello is ignored"),
        }
    }
}

struct Outbound {
    send: SendStream,
    buffer: [u8; MAX_FRAMED],
}

impl Outbound {
    async fn write(&mut self, message: &ToRuntime) -> Result<(), Ending> {
        let bytes = encode(message, &mut self.buffer);
        match timeout(PATIENCE, self.send.write_all(bytes)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(gone(&error)),
            Err(_) => Err((SLOW, "the runtime has read nothing for 5 s".to_owned())),
        }
    }
}

struct Incoming {
    recv: RecvStream,
    deframer: Deframer,
    bytes: [u8; 2048],
    /// What of `bytes` the deframer has not taken yet.
    held: Range<usize>,
}

impl Incoming {
    fn new(recv: RecvStream) -> Self {
        Self { recv, deframer: Deframer::default(), bytes: [0; 2048], held: 0..0 }
    }

    /// Returns the next message; messages that do not decode are dropped.
    async fn next(&mut self) -> Result<ToServer, Ending> {
        loop {
            match self.deframer.next::<ToServer>() {
                Some(Ok(message)) => return Ok(message),
                Some(Err(error @ FramingError::TooLong(_))) => {
                    return Err((FOREIGN, error.to_string()));
                }
                Some(Err(error @ FramingError::Body(_))) => {
                    debug!("{error}");
                    continue;
                }
                None => {}
            }
            if self.held.is_empty() {
                match self.recv.read(&mut self.bytes).await {
                    Ok(Some(count)) => self.held = 0..count,
                    Ok(None) => return Err((END, "the runtime ended the conversation".to_owned())),
                    Err(error) => return Err(gone(&error)),
                }
            }
            // After `None` the deframer has room for one byte at least.
            self.held.start += self.deframer.push(&self.bytes[self.held.clone()]);
        }
    }
}

fn gone(error: &dyn std::fmt::Display) -> Ending {
    (END, error.to_string())
}

/// How long a runtime may take for its next word where it must say one.
const PATIENCE: Duration = Duration::from_secs(5);
/// At most 100 Hz, with room for the jitter of a 200 Hz source. [s]
const POSE_EVERY_S: f64 = 0.0095;
/// Runtimes ask four times a second at most.
const CLOCK_QUEUE: usize = 16;
