//! The talk with one runtime, from its seat to its last byte.

use std::sync::Arc;

use quinn::{Connection, SendStream};
use tokio::sync::mpsc;
use tracing::{debug, info};
use vizflyt_protocol::messages::{ClockReply, ClockRequest, Hello, ToRuntime, ToServer};
use vizflyt_protocol::time::ServerTime;

use super::control::{Ending, Incoming, Outbound, gone};
use super::greeting::why;
use super::{REPLACED, SLOW, images};
use crate::cameras::CameraSet;
use crate::clock;
use crate::events::Origin;
use crate::hub::Hub;
use crate::vehicle::{Seat, Vehicle};

/// Serves the runtime that took `seat` until either side ends it.
pub(super) async fn fly(
    hub: &Arc<Hub>,
    connection: &Connection,
    hello: &Hello,
    seat: &Seat,
    send: SendStream,
    incoming: Incoming,
) -> Ending {
    let (address, vehicle) = (connection.remote_address(), &seat.vehicle);
    let again = if seat.resumed { ", and resumes its flight" } else { "" };
    info!("{address}: {} flies '{}'{again}", hello.program, hello.vehicle);
    vehicle.note(&format!("{} at {address} connected{again}", hello.program));
    // Control goes out before images.
    let _ = send.set_priority(1);
    let (clock_sender, clock_requests) = mpsc::channel(CLOCK_QUEUE);
    seat.speaks_over(connection);
    let outlet = images::Lane::open(hub.clone(), vehicle.clone(), connection.clone(), seat.info.id);
    let ending = tokio::select! {
        ending = down(seat, send, clock_requests) => ending,
        ending = up(seat, incoming, clock_sender) => ending,
        ending = outlet.run() => ending,
        () = seat.evicted() => {
            (REPLACED, "a newer runtime took over after a second of silence".to_owned())
        }
        error = connection.closed() => gone(&error),
    };
    let reason = connection.close_reason().map_or_else(|| ending.1.clone(), |error| why(&error));
    vehicle.note(&format!("the runtime at {address} is gone: {reason}"));
    ending
}

/// Server to runtime: events first, then changed cameras, clock replies, and the newest pose.
async fn down(
    seat: &Seat,
    send: SendStream,
    mut clock_requests: mpsc::Receiver<ClockRequest>,
) -> Ending {
    let vehicle = &*seat.vehicle;
    let mut out = Outbound::new(send);
    let mut poses = vehicle.pose.subscribe();
    let mut log = vehicle.events.subscribe();
    log.mark_changed();
    let mut cursor = seat.first_event;
    let mut cameras = vehicle.cameras.subscribe();
    let mut told = cameras.borrow_and_update().clone();
    if let Err(ending) = out.write(&ToRuntime::Welcome(vehicle.welcome(&told))).await {
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

async fn tell(vehicle: &Vehicle, out: &mut Outbound, cursor: &mut u64) -> Result<(), Ending> {
    let entries = vehicle.events.read(cursor).map_err(|lagged| (SLOW, lagged.to_string()))?;
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
                seat.vehicle.report(report);
            }
            ToServer::Timing(timing) => {
                seat.vehicle.report_timing(timing);
            }
            ToServer::Event(event) => {
                seat.vehicle.log(Origin::Page, event);
            }
            ToServer::Hello(_) => debug!("a second Hello is ignored"),
        }
    }
}

/// At most 100 Hz, with room for the jitter of a 200 Hz source. [s]
const POSE_EVERY_S: f64 = 0.0095;
/// Runtimes ask four times a second at most.
const CLOCK_QUEUE: usize = 16;
