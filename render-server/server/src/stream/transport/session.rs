//! The talk with one client, from its lease to its last byte.

use std::sync::Arc;

use quinn::{Connection, SendStream};
use tokio::sync::{mpsc, watch as cell};
use tracing::{debug, info};
use vizflyt_protocol::messages::{
    ClockReply, ClockRequest, Datagram, HeardEvents, Hello, PoseSample, Purpose, ToRuntime,
    ToServer, Welcome,
};
use vizflyt_protocol::packet::framing::{MAX_FRAMED, encode_body};
use vizflyt_protocol::time::ServerTime;

use super::control::{Ending, Incoming, Outbound, gone};
use super::greeting::why;
use super::{REPLACED, SLOW, images};
use crate::clock;
use crate::flights::events::Origin;
use crate::flights::vehicle::{ControlLease, Vehicle, WatchLease};
use crate::hub::Hub;
use crate::render::cameras::CameraSet;

/// Serves the runtime that took `lease` until either side ends it.
pub(super) async fn fly(
    hub: &Arc<Hub>,
    connection: &Connection,
    hello: &Hello,
    lease: &ControlLease,
    send: SendStream,
    incoming: Incoming,
) -> Ending {
    let (address, vehicle) = (connection.remote_address(), &lease.vehicle);
    let again = if lease.resumed { ", and resumes its flight" } else { "" };
    info!("{address}: {} flies '{}'{again}", hello.program, hello.vehicle);
    vehicle.note(&format!("{} at {address} connected{again}", hello.program));
    lease.speaks_over(connection);
    let talk = Talk {
        hub,
        vehicle,
        connection,
        first_event: lease.first_event.max(hello.heard_events.of(hub.boot)),
        heard_events: lease.heard_events,
    };
    let ending = tokio::select! {
        ending = talk.run(lease.info.id, Purpose::Fly, Some(lease), send, incoming) => ending,
        () = lease.evicted() => {
            (REPLACED, "a newer runtime took over after a second of silence".to_owned())
        }
    };
    let reason = connection.close_reason().map_or_else(|| ending.1.clone(), |error| why(&error));
    vehicle.note(&format!("the runtime at {address} is gone: {reason}"));
    ending
}

/// Serves a watcher until either side ends it.
pub(super) async fn watch(
    hub: &Arc<Hub>,
    connection: &Connection,
    hello: &Hello,
    lease: &WatchLease,
    send: SendStream,
    incoming: Incoming,
) -> Ending {
    info!("{}: {} watches '{}'", connection.remote_address(), hello.program, hello.vehicle);
    let talk = Talk {
        hub,
        vehicle: &lease.vehicle,
        connection,
        first_event: lease.first_event.max(hello.heard_events.of(hub.boot)),
        heard_events: HeardEvents::default(),
    };
    Box::pin(talk.run(lease.id, Purpose::Watch, None, send, incoming)).await
}

/// A conversation with one client.
struct Talk<'a> {
    hub: &'a Arc<Hub>,
    vehicle: &'a Arc<Vehicle>,
    connection: &'a Connection,
    first_event: u64,
    heard_events: HeardEvents,
}

impl Talk<'_> {
    async fn run(
        &self,
        id: u64,
        purpose: Purpose,
        lease: Option<&ControlLease>,
        send: SendStream,
        incoming: Incoming,
    ) -> Ending {
        // Control goes out before images.
        let _ = send.set_priority(i32::MAX);
        let (clock_sender, clock_requests) = mpsc::channel(CLOCK_QUEUE);
        let (heard_sender, heard) = cell::channel(0);
        let (hub, vehicle) = (self.hub.clone(), self.vehicle.clone());
        let senders =
            images::ImageSenders::open(hub, vehicle, self.connection.clone(), id, purpose);
        tokio::select! {
            ending = self.down(send, clock_requests, heard) => ending,
            ending = up(lease, incoming, &clock_sender, &heard_sender) => ending,
            ending = senders.run() => ending,
            error = self.connection.closed() => gone(&error),
        }
    }

    /// Server to client: events first, then what was heard of its own, changed cameras, clock
    /// replies, and the newest pose.
    async fn down(
        &self,
        send: SendStream,
        mut clock_requests: mpsc::Receiver<ClockRequest>,
        mut heard: cell::Receiver<u64>,
    ) -> Ending {
        let vehicle = &**self.vehicle;
        let mut out = Outbound::new(send);
        let mut poses = vehicle.pose.subscribe();
        let mut log = vehicle.events.subscribe();
        log.mark_changed();
        let mut cursor = self.first_event;
        let mut cameras = vehicle.cameras.subscribe();
        let mut told = cameras.borrow_and_update().clone();
        let (boot, heard_events) = (self.hub.boot, self.heard_events);
        let welcome = Welcome { boot, heard_events, arena: vehicle.welcome(&told) };
        if let Err(ending) = out.write(&ToRuntime::Welcome(welcome)).await {
            return ending;
        }
        let mut last_pose = ServerTime::ZERO;
        loop {
            let written = tokio::select! {
                biased;
                _ = log.changed() => {
                    log.mark_unchanged();
                    tell(vehicle, &mut out, &mut cursor).await
                }
                Ok(()) = heard.changed() => {
                    let seq = *heard.borrow_and_update();
                    out.write(&ToRuntime::Heard(seq)).await
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
                    if let Some(pose) = newest
                        && pose.stamp.seconds_since(last_pose) >= POSE_EVERY_S
                    {
                        last_pose = pose.stamp;
                        self.tell_pose(&pose);
                    }
                    Ok(())
                }
            };
            if let Err(ending) = written {
                return ending;
            }
        }
    }

    /// Poses are datagrams: a lost one holds up nothing.
    fn tell_pose(&self, pose: &PoseSample) {
        let mut buffer = [0; MAX_FRAMED];
        let bytes = encode_body(&Datagram::Pose(*pose), &mut buffer);
        if let Err(error) = self.connection.send_datagram(bytes::Bytes::copy_from_slice(bytes)) {
            debug!("{}: pose not sent: {error}", self.connection.remote_address());
        }
    }
}

async fn tell(vehicle: &Vehicle, out: &mut Outbound, cursor: &mut u64) -> Result<(), Ending> {
    let entries = vehicle.events.read(cursor).map_err(|lagged| (SLOW, lagged.to_string()))?;
    for entry in entries {
        if entry.origin == Origin::Server {
            let (seq, event) = (entry.index + 1, entry.event);
            out.write(&ToRuntime::Event { seq, event }).await?;
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

/// Client to server; a watcher, who has no lease, is heard asking the time only.
async fn up(
    lease: Option<&ControlLease>,
    mut incoming: Incoming,
    clock_requests: &mpsc::Sender<ClockRequest>,
    heard: &cell::Sender<u64>,
) -> Ending {
    loop {
        let message = match incoming.next().await {
            Ok(message) => message,
            Err(ending) => return ending,
        };
        if let Some(lease) = lease {
            lease.heard(clock::now());
        }
        match (message, lease) {
            // A full queue means that replies cannot leave; a late reply would mislead anyway.
            (ToServer::Clock(request), _) => drop(clock_requests.try_send(request)),
            (ToServer::Telemetry(report), Some(lease)) => lease.vehicle.report(report),
            (ToServer::Timing(timing), Some(lease)) => {
                lease.vehicle.report_timing(timing);
            }
            (ToServer::Imu(readings), Some(lease)) => lease.vehicle.feel(&readings),
            (ToServer::Event { seq, event }, Some(lease)) => {
                if lease.hear(seq) {
                    lease.vehicle.log(Origin::Page, event);
                }
                heard.send_modify(|newest| *newest = seq.max(*newest));
            }
            (ToServer::Heard(seq), _) => debug!("events up to {seq} were heard"),
            (ToServer::Hello(_), _) => debug!("a second Hello is ignored"),
            (_, None) => debug!("a watcher has nothing to tell"),
        }
    }
}

/// At most 100 Hz, with room for the jitter of a 200 Hz source. [s]
const POSE_EVERY_S: f64 = 0.0095;
/// Runtimes ask four times a second at most.
const CLOCK_QUEUE: usize = 16;
