//! Images to one subscriber: one stream per image, few in flight, reset after a deadline.
//!
//! In flight means handed to the transport and not yet acknowledged. Measurements: resetting an older stream
//! whenever a newer image is ready starves an overloaded link completely. Waiting for room with the newest
//! image, and resetting only after [`DEADLINE`], uses the full capacity of the link.
//!
//! [`crate::stream::rate_control`] estimates the capacity of the link from the delivery of each image.
//!
//! There is one task per slot of the subscriptions, started when the subscriber connects or its K grows. It
//! writes an image's slices as the encoder produces them, without a copy, and never waits for another camera.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use quinn::{Connection, SendStream};
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::trace;
use vizflyt_protocol::messages::{EventKind, Purpose};
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::time::ServerTime;
use zerocopy::IntoBytes;

use super::{END, VarInt};
use crate::clock;
use crate::stream::Rooms;
use crate::stream::rate_control::{DECIDE_EVERY, RateController, SentImage};
use crate::stream::subscriptions::{InFlightImage, MAX_IN_FLIGHT, Part, Slots};
use crate::stream::vehicle::VehicleStream;
use crate::timing::RateMeter;
use vizflyt_process::lock;

/// Image senders of one session; ends its subscription when dropped.
pub(super) struct ImageSenders {
    context: SenderContext,
    places: Slots,
    allowed: u32,
}

/// Context shared by all senders.
#[derive(Clone)]
struct SenderContext {
    rooms: Rooms,
    vehicle: usize,
    connection: Connection,
    id: u64,
    /// Only for the runtime: a watcher's link does not affect the flight.
    rate_controller: Option<Arc<Mutex<RateController>>>,
}

impl ImageSenders {
    /// Subscribes session `id` to the images of `vehicle`.
    pub(super) fn open(
        rooms: Rooms,
        vehicle: usize,
        connection: Connection,
        id: u64,
        purpose: Purpose,
    ) -> Self {
        let allowed = in_flight(connection.min_rtt(), USUAL_RATE_HZ);
        let places = rooms.streaming.subscriptions.open(vehicle, id, purpose, allowed);
        let adapt = rooms.streaming.adapt.toward(connection.remote_address().ip());
        let rate_controller =
            (purpose == Purpose::Fly).then(|| Arc::new(Mutex::new(RateController::new(adapt))));
        rooms.streaming.vehicles[vehicle].level.store(0, Ordering::Relaxed);
        let context = SenderContext { rooms, vehicle, connection, id, rate_controller };
        Self { context, places, allowed }
    }

    /// Sends images until the connection ends.
    pub(super) async fn run(mut self) -> (VarInt, String) {
        let mut senders = JoinSet::new();
        self.spawn(&mut senders, 0);
        let rate = RateMeter::default();
        let mut every_second = interval(Duration::from_secs(1));
        every_second.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let rendered_rate = RateMeter::default();
        let mut decide = interval(DECIDE_EVERY);
        decide.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                _ = senders.join_next() => {
                    return (END, "a sender of images has failed".to_owned());
                }
                _ = every_second.tick() => {
                    let SenderContext { rooms, vehicle, connection, id, .. } = &self.context;
                    let hz = rate.of(rooms.ticks(), clock::now()).max(USUAL_RATE_HZ);
                    let allowed = in_flight(connection.min_rtt(), hz);
                    let before = self.allowed;
                    self.allowed = before.max(allowed);
                    self.spawn(&mut senders, before);
                    rooms.streaming.subscriptions.allow(*vehicle, *id, allowed);
                }
                _ = decide.tick() => {
                    let cameras = self.context.stream().images.cameras.iter();
                    let rendered = cameras.map(|counters| counters.counts().rendered).sum();
                    self.context.decide(rendered_rate.of(rendered, clock::now()));
                }
            }
        }
    }

    /// Starts the senders of slots `before` to `allowed` of every camera.
    fn spawn(&self, senders: &mut JoinSet<()>, before: u32) {
        for (camera, slots) in self.places.iter().enumerate() {
            for (place, image) in slots.iter().enumerate() {
                if (before..self.allowed).contains(&(place as u32)) {
                    senders.spawn(send(self.context.clone(), camera, place, image.clone()));
                }
            }
        }
    }
}

impl SenderContext {
    fn stream(&self) -> &VehicleStream {
        &self.rooms.streaming.vehicles[self.vehicle]
    }

    /// Updates the level of the images; `wanted_hz` is the render rate of all cameras in total.
    fn decide(&self, wanted_hz: f64) {
        let Some(rate_controller) = &self.rate_controller else { return };
        let change = lock(rate_controller).decide(clock::now(), wanted_hz);
        if let Some(change) = change {
            self.stream().level.store(change.to, Ordering::Relaxed);
            self.rooms.flights.vehicles[self.vehicle].publish(EventKind::Note, &change.text());
        }
    }
}

impl Drop for ImageSenders {
    fn drop(&mut self) {
        let SenderContext { rooms, vehicle, id, .. } = &self.context;
        rooms.streaming.subscriptions.close(*vehicle, *id);
    }
}

/// Returns K: one image being acknowledged, plus the images of one round trip.
fn in_flight(min_rtt: Duration, rate_hz: f64) -> u32 {
    let spanned = (min_rtt.as_secs_f64() * rate_hz).ceil();
    1 + (spanned as u32).clamp(1, MAX_IN_FLIGHT - 1)
}

/// Sends the images of one slot until the task is aborted.
async fn send(context: SenderContext, camera: usize, place: usize, image: Arc<InFlightImage>) {
    let SenderContext { rooms, vehicle, connection, id, rate_controller } = &context;
    let streaming = &rooms.streaming;
    loop {
        let (header, priority) = image.image().await;
        let start = clock::now();
        let mut sent = Sent { bytes: 0, encode_end: None };
        let delivered = deliver(connection, &image, &header, priority, &mut sent).await;
        let end = clock::now();
        // Statistics count only the runtime's images.
        if let Some(rate_controller) = rate_controller {
            let images = &context.stream().images;
            if delivered {
                streaming.send_durations.add(start, end);
                images.sent.fetch_add(1, Ordering::Relaxed);
                images.bytes.fetch_add(sent.bytes as u64, Ordering::Relaxed);
            } else {
                images.late.fetch_add(1, Ordering::Relaxed);
                images.cameras[camera].count_late();
            }
            lock(rate_controller).landed(&SentImage {
                bytes: sent.bytes,
                // Encoding time does not count for the link.
                handed: sent.encode_end.unwrap_or(start),
                ended: end,
                delivered,
                min_rtt: connection.min_rtt(),
            });
        }
        let ms = end.seconds_since(start) * 1e3;
        trace!(camera, delivered, ms, "send");
        streaming.subscriptions.landed(*vehicle, camera, *id, place, &image);
    }
}

/// Progress of an image.
struct Sent {
    /// Bytes of bitstream sent.
    bytes: usize,
    /// Set when encoding has ended.
    encode_end: Option<ServerTime>,
}

/// Sends an image on a separate stream. Returns whether all of it was acknowledged in time.
async fn deliver(
    connection: &Connection,
    image: &InFlightImage,
    header: &ImageHeader,
    priority: i32,
    sent: &mut Sent,
) -> bool {
    let Ok(Ok(mut stream)) = timeout(DEADLINE, connection.open_uni()).await else {
        return false;
    };
    // Fails only if the stream has ended already.
    let _ = stream.set_priority(priority);
    let delivered = timeout(DEADLINE, write(&mut stream, image, header, sent)).await;
    let delivered = delivered.ok().flatten().is_some();
    if !delivered {
        // Fails only if it is finished and acknowledged after all.
        let _ = stream.reset(VarInt::from_u32(0));
    }
    delivered
}

async fn write(
    stream: &mut SendStream,
    image: &InFlightImage,
    header: &ImageHeader,
    sent: &mut Sent,
) -> Option<()> {
    let send = clock::now();
    stream.write_all(header.as_bytes()).await.ok()?;
    let encode_end = loop {
        match image.part().await {
            Part::Bytes(bytes) => {
                sent.bytes += bytes.len();
                stream.write_chunk(bytes).await.ok()?;
            }
            Part::End { encode_end } => break encode_end,
            Part::Cut => return None,
        }
    };
    sent.encode_end = Some(encode_end);
    let trailer = ImageTrailer::new(u32::try_from(sent.bytes).ok()?, encode_end, send);
    stream.write_all(trailer.as_bytes()).await.ok()?;
    stream.finish().ok()?;
    // `None` means acknowledged; a code means that the receiver stopped the stream.
    stream.stopped().await.ok()?.is_none().then_some(())
}

/// Maximum age of an image: an older one is of no use to the vehicle, and its retransmissions delay newer ones.
const DEADLINE: Duration = Duration::from_millis(150);
/// Typical rate on a small machine, and the minimum assumed for K. [Hz]
const USUAL_RATE_HZ: f64 = 60.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn k_grows_with_round_trip_and_rate() {
        assert_eq!(in_flight(Duration::from_micros(200), 60.0), 2);
        assert_eq!(in_flight(Duration::from_millis(20), 60.0), 3);
        assert_eq!(in_flight(Duration::from_millis(40), 100.0), 5);
        assert_eq!(in_flight(Duration::from_secs(9), 100.0), 8);
    }
}
