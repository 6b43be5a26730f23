//! Images to one runtime: a stream each, few in flight, reset past a deadline.
//!
//! In flight means handed to the transport and not yet acknowledged. Measured: resetting an older
//! stream whenever a newer image is ready starves an overloaded link altogether; waiting for room
//! with the newest image, and resetting only past [`DEADLINE`], delivers what the link carries.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use quinn::Connection;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::trace;
use zerocopy::IntoBytes;

use super::{END, VarInt};
use crate::clock;
use crate::hub::Hub;
use crate::outlet::Outgoing;
use crate::stats::Rate;
use crate::vehicle::Vehicle;

/// The way of images to one session; closes the outlet when dropped.
pub(super) struct Lane {
    hub: Arc<Hub>,
    vehicle: Arc<Vehicle>,
    connection: Connection,
    id: u64,
    images: mpsc::UnboundedReceiver<Outgoing>,
}

impl Lane {
    /// Opens the outlet of `vehicle` for its session `id`.
    pub(super) fn open(
        hub: Arc<Hub>,
        vehicle: Arc<Vehicle>,
        connection: Connection,
        id: u64,
    ) -> Self {
        let allowed = in_flight(connection.min_rtt(), USUAL_RATE_HZ);
        let images = hub.outlet.open(vehicle.index, id, allowed);
        Self { hub, vehicle, connection, id, images }
    }

    /// Sends images until the connection ends.
    pub(super) async fn run(mut self) -> (VarInt, String) {
        let mut sending = JoinSet::new();
        let rate = Rate::default();
        let mut every_second = interval(Duration::from_secs(1));
        every_second.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                image = self.images.recv() => match image {
                    Some(image) => {
                        let (hub, vehicle) = (self.hub.clone(), self.vehicle.clone());
                        sending.spawn(send(hub, vehicle, self.connection.clone(), self.id, image));
                    }
                    None => return (END, "images go to another session".to_owned()),
                },
                _ = sending.join_next(), if !sending.is_empty() => {}
                _ = every_second.tick() => {
                    let ticks = self.hub.stats.ticks.load(Ordering::Relaxed);
                    let hz = rate.of(ticks, clock::now()).max(USUAL_RATE_HZ);
                    let allowed = in_flight(self.connection.min_rtt(), hz);
                    self.hub.outlet.allow(self.vehicle.index, self.id, allowed);
                }
            }
        }
    }
}

impl Drop for Lane {
    fn drop(&mut self) {
        self.hub.outlet.close(self.vehicle.index, self.id);
    }
}

/// Returns K: one image being acknowledged, and as many as a round trip spans.
fn in_flight(min_rtt: Duration, rate_hz: f64) -> u32 {
    let spanned = (min_rtt.as_secs_f64() * rate_hz).ceil();
    1 + (spanned as u32).clamp(1, MOST_IN_FLIGHT - 1)
}

async fn send(
    hub: Arc<Hub>,
    vehicle: Arc<Vehicle>,
    connection: Connection,
    session: u64,
    mut image: Outgoing,
) {
    let start = clock::now();
    image.header.send_ns = start.as_ns().into();
    let delivered = deliver(&connection, &[image.header.as_bytes(), &image.payload]).await;
    let end = clock::now();
    if delivered {
        hub.stats.send.add(start, end);
        vehicle.images.sent.fetch_add(1, Ordering::Relaxed);
        vehicle.images.bytes.fetch_add(image.payload.len() as u64, Ordering::Relaxed);
    } else {
        vehicle.images.late.fetch_add(1, Ordering::Relaxed);
        vehicle.images.cameras[image.camera].late();
    }
    trace!(camera = image.camera, delivered, ms = end.seconds_since(start) * 1e3, "send");
    hub.outlet.recycle(image.payload);
    hub.outlet.landed(vehicle.index, session, image.camera);
}

/// Sends `parts` on a stream of their own; returns whether all was acknowledged in time.
async fn deliver(connection: &Connection, parts: &[&[u8]]) -> bool {
    let Ok(Ok(mut stream)) = timeout(DEADLINE, connection.open_uni()).await else {
        return false;
    };
    let whole = async {
        for part in parts {
            stream.write_all(part).await.ok()?;
        }
        stream.finish().ok()?;
        // `None` inside is "acknowledged"; a code is "the runtime does not want it".
        stream.stopped().await.ok()?.is_none().then_some(())
    };
    if let Ok(delivered) = timeout(DEADLINE, whole).await {
        delivered.is_some()
    } else {
        // Fails only if it is finished and acknowledged after all.
        let _ = stream.reset(VarInt::from_u32(0));
        false
    }
}

/// Older than this, an image helps no pilot, and its retransmissions delay newer ones.
const DEADLINE: Duration = Duration::from_millis(150);
/// What a vehicle's camera is drawn at on a small machine; K never assumes less. [Hz]
const USUAL_RATE_HZ: f64 = 60.0;
/// 100 ms of round trip at 70 Hz; more would only queue.
const MOST_IN_FLIGHT: u32 = 8;

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
