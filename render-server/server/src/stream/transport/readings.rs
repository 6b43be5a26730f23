//! Readings of sensors beside the cameras to one session: a stream each, one in flight per sensor, reset past a deadline.
//!
//! Newest wins: when a reading has been acknowledged or given up, the newest is sent next. They leave behind images, and
//! take no part in the rate control: a LiDAR of 16 x 1024 beams at 10 Hz is 26 Mbit/s at most.

use std::convert::Infallible;
use std::sync::atomic::Ordering;
use std::time::Duration;

use quinn::{Connection, VarInt};
use tokio::task::JoinSet;
use tokio::time::timeout;
use tracing::trace;
use vizflyt_protocol::messages::Purpose;
use vizflyt_protocol::sensor::MAX_SENSORS;

use crate::render::sensors::MadeReading;
use crate::stream::Rooms;

/// Below every image's.
const PRIORITY: i32 = i32::MIN;
/// Older than this, a reading helps no pilot.
const DEADLINE: Duration = Duration::from_millis(250);

/// Sends the newest readings of a vehicle until the session ends and drops this.
pub(super) async fn send(
    rooms: Rooms,
    vehicle: usize,
    connection: Connection,
    purpose: Purpose,
) -> Infallible {
    let mut senders = JoinSet::new();
    for sensor in 0..rooms.rendering.sensors[vehicle].newest().configs.len().min(MAX_SENSORS) {
        senders.spawn(send_of(rooms.clone(), vehicle, sensor, connection.clone(), purpose));
    }
    while senders.join_next().await.is_some() {}
    // A vehicle without sensors.
    std::future::pending().await
}

async fn send_of(
    rooms: Rooms,
    vehicle: usize,
    sensor: usize,
    connection: Connection,
    purpose: Purpose,
) {
    let sensors = &rooms.rendering.sensors[vehicle];
    let Some(mut newest) = sensors.readings(sensor) else { return };
    while newest.changed().await.is_ok() {
        let Some(reading) = newest.borrow_and_update().clone() else { continue };
        let delivered = deliver(&connection, &reading).await;
        // Figures are the runtime's.
        if purpose == Purpose::Fly {
            let counters = &sensors.counters[sensor];
            let counter = if delivered { &counters.sent } else { &counters.late };
            counter.fetch_add(1, Ordering::Relaxed);
        }
        trace!(sensor, delivered, bytes = reading.bytes.len(), "send reading");
    }
}

/// Sends a reading on a stream of its own; returns whether all was acknowledged in time.
async fn deliver(connection: &Connection, reading: &MadeReading) -> bool {
    let Ok(Ok(mut stream)) = timeout(DEADLINE, connection.open_uni()).await else {
        return false;
    };
    // Fails only if the stream has ended already.
    let _ = stream.set_priority(PRIORITY);
    let write = async {
        stream.write_chunk(reading.bytes.clone()).await.ok()?;
        stream.finish().ok()?;
        // `None` inside is "acknowledged"; a code is "the other side does not want it".
        stream.stopped().await.ok()?.is_none().then_some(())
    };
    let delivered = timeout(DEADLINE, write).await.ok().flatten().is_some();
    if !delivered {
        // Fails only if it is finished and acknowledged after all.
        let _ = stream.reset(VarInt::from_u32(0));
    }
    delivered
}
