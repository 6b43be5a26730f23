//! The encode thread: rendered ticks in, image packets out; the ticks then go to the previews.
//!
//! It waits for room in the [`Subscriptions`](crate::stream::subscriptions), then takes the newest rendered
//! tick; older ticks are skipped unencoded. [`crate::stream::encode::slices`] encodes one image.

pub mod slices;

use std::time::Duration;

use tracing::warn;
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_protocol::messages::MAX_CAMERAS;
use vizflyt_rgbd::EncodeOptions;

use crate::flights::Flights;
use crate::render::rendered::RenderQueue;
use crate::stop::Stop;
use crate::stream::Streaming;
use crate::stream::encode::slices::SliceEncoder;

/// Encodes until the server stops.
pub fn run(
    streaming: &Streaming,
    flights: &Flights,
    ticks: &RenderQueue,
    options: EncodeOptions,
    stop: &Stop,
) {
    let mut encoder = SliceEncoder::new(options);
    let mut order: Vec<usize> = Vec::new();
    // Image counters by camera, for links that do not have room for all images.
    let mut turns = [[0u32; MAX_CAMERAS]; MAX_VEHICLES];
    while !stop.is_set() {
        let wanted = streaming.subscriptions.wait_for_room(PATIENCE);
        if !wanted.anything() {
            continue;
        }
        let Some(tick) = ticks.take(PATIENCE) else { continue };
        // Images of the newest tick first: older images of other cameras follow.
        order.clear();
        order.extend((0..tick.slots.len()).filter(|&index| tick.slots[index].fresh));
        order.sort_by_key(|&index| std::cmp::Reverse(tick.slots[index].seq));
        // A slow link gets one of `keep_one_in` images; watchers get the same images as the runtime.
        order.retain(|&index| {
            let slot = &tick.slots[index];
            let turn = &mut turns[slot.vehicle][slot.camera];
            *turn = turn.wrapping_add(1);
            turn.is_multiple_of(streaming.vehicles[slot.vehicle].level().keep_one_in)
        });
        let mut together = [0u32; MAX_VEHICLES];
        for &index in &order {
            let slot = &tick.slots[index];
            if wanted.fly[slot.vehicle][slot.camera] {
                together[slot.vehicle] |= 1 << slot.camera;
            }
        }
        for &index in &order {
            let slot = &tick.slots[index];
            let (vehicle, camera) = (slot.vehicle, slot.camera);
            if !wanted.stream[vehicle][camera] {
                continue;
            }
            encoder.set_options(streaming.vehicles[vehicle].level().options(&options));
            match encoder.send(&streaming.subscriptions, slot, together[vehicle]) {
                Ok(Some((start, end))) => {
                    streaming.encode_durations.add(start, end);
                    // Images only for watchers do not count for the runtime.
                    if together[vehicle] >> camera & 1 == 1 {
                        streaming.vehicles[vehicle].images.cameras[camera].count_sent(slot.counted);
                    }
                }
                Ok(None) => {}
                Err(error) => {
                    streaming.vehicles[vehicle].images.cameras[camera].count_failed(slot.counted);
                    let name = &flights.vehicles[vehicle].name;
                    warn!("{name}: camera {camera}: {error:#}; image {} is skipped", slot.seq);
                }
            }
        }
        if streaming.subscriptions.viewers() > 0 || flights.any_under_way() {
            ticks.offer_previews(tick);
        }
    }
}

/// Maximum delay until a stop is noticed.
const PATIENCE: Duration = Duration::from_millis(100);
