//! Sensor readings (except images) to one session: one stream per reading, one in flight per sensor, reset
//! after a deadline.
//!
//! Newest wins: when a reading has been acknowledged or dropped, the newest is sent next. Readings have a lower
//! priority than images, and take no part in the rate control: a LiDAR of 16 x 1024 beams at 10 Hz needs at
//! most 26 Mbit/s.

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

/// Lower than the priority of every image.
const PRIORITY: i32 = i32::MIN;
/// Maximum age of a reading.
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
    // Vehicles without sensors wait here.
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
        // Statistics count only the runtime's readings.
        if purpose == Purpose::Fly {
            let counters = &sensors.counters[sensor];
            let counter = if delivered { &counters.sent } else { &counters.late };
            counter.fetch_add(1, Ordering::Relaxed);
        }
        trace!(sensor, delivered, bytes = reading.bytes.len(), "send reading");
    }
}

/// Sends a reading on a separate stream. Returns whether all of it was acknowledged in time.
async fn deliver(connection: &Connection, reading: &MadeReading) -> bool {
    let Ok(Ok(mut stream)) = timeout(DEADLINE, connection.open_uni()).await else {
        return false;
    };
    // Fails only if the stream has ended already.
    let _ = stream.set_priority(PRIORITY);
    let write = async {
        stream.write_chunk(reading.bytes.clone()).await.ok()?;
        stream.finish().ok()?;
        // `None` means acknowledged; a code means that the receiver stopped the stream.
        stream.stopped().await.ok()?.is_none().then_some(())
    };
    let delivered = timeout(DEADLINE, write).await.ok().flatten().is_some();
    if !delivered {
        // Fails only if it is finished and acknowledged after all.
        let _ = stream.reset(VarInt::from_u32(0));
    }
    delivered
}
