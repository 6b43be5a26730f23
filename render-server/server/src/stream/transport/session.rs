//! Session with one client, from its lease to the end of the connection.

use std::sync::atomic::Ordering;

use quinn::{Connection, SendStream};
use tokio::sync::{mpsc, watch as cell};
use tracing::{debug, info};
use vizflyt_protocol::messages::{
    ArenaInfo, ClockReply, ClockRequest, Datagram, Hello, PoseSample, Purpose, ReceivedEvents,
    ToRuntime, ToServer, Welcome,
};
use vizflyt_protocol::packet::framing::{MAX_FRAMED, encode_body};
use vizflyt_protocol::time::ServerTime;

use super::control::{Ending, Incoming, Outbound, gone};
use super::greeting::why;
use super::images::ImageSenders;
use super::{REPLACED, SLOW, feed, readings};
use crate::clock;
use crate::flights::control_lease::{ControlLease, WatchLease};
use crate::flights::events::Origin;
use crate::flights::vehicle::VehicleFlight;
use crate::render::cameras::CameraSet;
use crate::render::sensors::SensorSet;
use crate::stream::Rooms;

/// Session with one client after its lease was granted.
pub(super) struct Session<'a> {
    pub(super) rooms: &'a Rooms,
    pub(super) vehicle: &'a VehicleFlight,
    pub(super) connection: &'a Connection,
    pub(super) hello: &'a Hello,
}

impl Session<'_> {
    /// Serves the runtime that took control until either side ends it.
    pub(super) async fn fly(
        &self,
        lease: &ControlLease,
        send: SendStream,
        incoming: Incoming,
    ) -> Ending {
        let Self { rooms, vehicle, connection, hello } = self;
        let address = connection.remote_address();
        let again = if lease.resumed { ", and resumes its flight" } else { "" };
        info!("{address}: {} flies '{}'{again}", hello.program, hello.vehicle);
        vehicle.note(&format!("{} at {address} connected{again}", hello.program));
        let stream = &rooms.streaming.vehicles[vehicle.index];
        if !lease.resumed {
            stream.begin_flight();
        }
        let _connected = stream.connect(lease.info.id, connection);
        if let Some(key) = feed::key_of(connection) {
            stream.open_feed(key);
        }
        let ending = tokio::select! {
            ending = self.run(lease.info.id, Some(lease), lease.first_event, send, incoming) => ending,
            () = lease.evicted() => {
                (REPLACED, "a newer runtime took over after a second of silence".to_owned())
            }
        };
        let reason =
            connection.close_reason().map_or_else(|| ending.1.clone(), |error| why(&error));
        vehicle.note(&format!("the runtime at {address} is gone: {reason}"));
        ending
    }

    /// Serves a watcher until either side ends it.
    pub(super) async fn watch(
        &self,
        lease: &WatchLease,
        send: SendStream,
        incoming: Incoming,
    ) -> Ending {
        let (address, hello) = (self.connection.remote_address(), self.hello);
        info!("{address}: {} watches '{}'", hello.program, hello.vehicle);
        Box::pin(self.run(lease.id, None, lease.first_event, send, incoming)).await
    }

    async fn run(
        &self,
        id: u64,
        lease: Option<&ControlLease>,
        first_event: u64,
        send: SendStream,
        incoming: Incoming,
    ) -> Ending {
        // Control messages have priority over images.
        let _ = send.set_priority(i32::MAX);
        let (clock_sender, clock_requests) = mpsc::channel(CLOCK_QUEUE);
        let (received_sender, received) = cell::channel(0);
        let purpose = if lease.is_some() { Purpose::Fly } else { Purpose::Watch };
        let (rooms, vehicle) = (self.rooms.clone(), self.vehicle.index);
        let readings = readings::send(rooms.clone(), vehicle, self.connection.clone(), purpose);
        let senders = ImageSenders::open(rooms, vehicle, self.connection.clone(), id, purpose);
        let received_events =
            lease.map_or_else(ReceivedEvents::default, |lease| lease.received_events);
        let client_received = self.hello.received_events.of(self.rooms.flights.instance_id);
        let cursor = first_event.max(client_received);
        tokio::select! {
            ending = self.send(send, received_events, cursor, clock_requests, received) => ending,
            ending = self.receive(lease, incoming, &clock_sender, &received_sender) => ending,
            ending = senders.run() => ending,
            never = readings => match never {},
            error = self.connection.closed() => gone(&error),
        }
    }

    /// Sends to the client: events first, then acknowledgements, changed cameras, clock replies, and the newest
    /// pose.
    async fn send(
        &self,
        send: SendStream,
        received_events: ReceivedEvents,
        mut cursor: u64,
        mut clock_requests: mpsc::Receiver<ClockRequest>,
        mut received: cell::Receiver<u64>,
    ) -> Ending {
        let (vehicle, index) = (self.vehicle, self.vehicle.index);
        let mut out = Outbound::new(send);
        let mut poses = self.rooms.localization.vehicles[index].newest.subscribe();
        let mut log = vehicle.events.subscribe();
        log.mark_changed();
        let mut cameras = self.rooms.rendering.cameras[index].subscribe();
        let mut sent = cameras.borrow_and_update().clone();
        let mut sensors = self.rooms.rendering.sensors[index].subscribe();
        let mut sent_sensors = sensors.borrow_and_update().clone();
        let arena = ArenaInfo {
            cameras: sent.infos.iter().cloned().collect(),
            sensors: sent_sensors.infos.iter().cloned().collect(),
            ..vehicle.arena.clone()
        };
        let boot = self.rooms.flights.instance_id;
        let feed_port = self.rooms.streaming.feed_port.load(Ordering::Relaxed);
        let welcome = Welcome { boot, received_events, arena, feed_port };
        if let Err(ending) = out.write(&ToRuntime::Welcome(welcome)).await {
            return ending;
        }
        let mut last_pose = ServerTime::ZERO;
        loop {
            let written = tokio::select! {
                biased;
                _ = log.changed() => {
                    log.mark_unchanged();
                    send_events(vehicle, &mut out, &mut cursor).await
                }
                Ok(()) = received.changed() => {
                    let seq = *received.borrow_and_update();
                    out.write(&ToRuntime::EventsReceived(seq)).await
                }
                _ = cameras.changed() => {
                    let newest = cameras.borrow_and_update().clone();
                    let before = std::mem::replace(&mut sent, newest);
                    send_cameras(&mut out, &before, &sent).await
                }
                _ = sensors.changed() => {
                    let newest = sensors.borrow_and_update().clone();
                    let before = std::mem::replace(&mut sent_sensors, newest);
                    send_sensors(&mut out, &before, &sent_sensors).await
                }
                Some(request) = clock_requests.recv() => {
                    let reply = ClockReply { sent: request.sent, answered: clock::now() };
                    out.write(&ToRuntime::Clock(reply)).await
                }
                _ = poses.changed() => {
                    let newest = poses.borrow_and_update().map(|newest| newest.sample);
                    if let Some(pose) = newest
                        && pose.stamp.seconds_since(last_pose) >= POSE_EVERY_S
                    {
                        last_pose = pose.stamp;
                        self.send_pose(&pose);
                    }
                    Ok(())
                }
            };
            if let Err(ending) = written {
                return ending;
            }
        }
    }

    /// Receives from the client; watchers may only send clock requests.
    async fn receive(
        &self,
        lease: Option<&ControlLease>,
        mut incoming: Incoming,
        clock_requests: &mpsc::Sender<ClockRequest>,
        received: &cell::Sender<u64>,
    ) -> Ending {
        let (vehicle, index, rooms) = (self.vehicle, self.vehicle.index, self.rooms);
        loop {
            let message = match incoming.next().await {
                Ok(message) => message,
                Err(ending) => return ending,
            };
            if let Some(lease) = lease {
                lease.renew(clock::now());
            }
            match (message, lease) {
                // A full queue means that replies cannot be sent; a late reply would be misleading anyway.
                (ToServer::Clock(request), _) => drop(clock_requests.try_send(request)),
                (ToServer::Telemetry(report), Some(_)) => vehicle.report(report),
                (ToServer::Timing(timing), Some(_)) => {
                    rooms.streaming.vehicles[index].report_timing(timing);
                }
                (ToServer::Imu(readings), Some(_)) => {
                    rooms.localization.vehicles[index].push_imu(&readings);
                }
                (ToServer::Event { seq, event }, Some(lease)) => {
                    if lease.receive_event(seq) {
                        vehicle.log(Origin::Page, event);
                    }
                    received.send_modify(|newest| *newest = seq.max(*newest));
                }
                (ToServer::EventsReceived(seq), lease) => {
                    debug!("events up to {seq} were received");
                    if lease.is_some() {
                        vehicle.received.send_replace(seq);
                    }
                }
                (ToServer::Guarded(guarded), Some(_)) => {
                    vehicle.guarded.send_replace(Some(guarded));
                }
                (ToServer::Hello(_), _) => debug!("a second Hello is ignored"),
                (_, None) => debug!("a report of a watcher is ignored"),
            }
        }
    }

    /// Sends a pose as a datagram, so that a lost one delays no other data.
    fn send_pose(&self, pose: &PoseSample) {
        let mut buffer = [0; MAX_FRAMED];
        let bytes = encode_body(&Datagram::Pose(*pose), &mut buffer);
        if let Err(error) = self.connection.send_datagram(bytes::Bytes::copy_from_slice(bytes)) {
            debug!("{}: pose not sent: {error}", self.connection.remote_address());
        }
    }
}

async fn send_events(
    vehicle: &VehicleFlight,
    out: &mut Outbound,
    cursor: &mut u64,
) -> Result<(), Ending> {
    let entries = vehicle.events.read(cursor).map_err(|lagged| (SLOW, lagged.to_string()))?;
    for entry in entries {
        if entry.origin == Origin::Server {
            let (seq, event) = (entry.index + 1, entry.event);
            out.write(&ToRuntime::Event { seq, event }).await?;
        }
    }
    Ok(())
}

async fn send_cameras(
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

async fn send_sensors(
    out: &mut Outbound,
    before: &SensorSet,
    now: &SensorSet,
) -> Result<(), Ending> {
    for (index, sensor) in now.infos.iter().enumerate() {
        if before.infos.get(index) != Some(sensor) {
            let sensor = sensor.clone();
            out.write(&ToRuntime::Sensor { index: index as u8, sensor }).await?;
        }
    }
    Ok(())
}

/// Minimum time between poses: at most 100 Hz, with a margin for the jitter of a 200 Hz source. [s]
const POSE_EVERY_S: f64 = 0.0095;
/// Capacity of the queue; runtimes send at most four clock requests per second.
const CLOCK_QUEUE: usize = 16;
