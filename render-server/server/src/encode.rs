//! The encode thread: drawn ticks in, image packets out; the ticks then go to the previews.
//!
//! Waits for room in the [`Outlet`](crate::outlet), then takes the newest drawn tick: what was
//! drawn meanwhile is skipped unencoded. Per image of 320x240: quantise 0.1 ms, encode about
//! 2 ms; buffers circulate, nothing of ours is allocated in the steady state.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use tracing::{trace_span, warn};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView};
use vizflyt_splat::DepthKind;

use crate::clock;
use crate::drawn::{DrawnImage, Ticks};
use crate::hub::{Hub, MAX_VEHICLES};
use crate::outlet::Outgoing;

/// Encodes until the server stops.
pub fn run(hub: &Arc<Hub>, ticks: &Ticks, options: EncodeOptions) {
    let mut stage = Stage::new(options);
    let mut order: Vec<usize> = Vec::new();
    while !hub.stop.is_set() {
        let wanted = hub.outlet.wait_for_room(PATIENCE);
        if !wanted.anything() {
            continue;
        }
        let Some(tick) = ticks.take(PATIENCE) else { continue };
        // The newest tick's first: an older image joins what the runtime has begun.
        order.clear();
        order.extend((0..tick.slots.len()).filter(|&index| tick.slots[index].fresh));
        order.sort_by_key(|&index| std::cmp::Reverse(tick.slots[index].seq));
        let mut together = [0u32; MAX_VEHICLES];
        for &index in &order {
            let slot = &tick.slots[index];
            if wanted.stream[slot.vehicle][slot.camera] {
                together[slot.vehicle] |= 1 << slot.camera;
            }
        }
        for &index in &order {
            let slot = &tick.slots[index];
            let (vehicle, camera) = (slot.vehicle, slot.camera);
            if !wanted.stream[vehicle][camera] {
                continue;
            }
            if let Err(error) = stage.encode(hub, slot, together[vehicle]) {
                hub.vehicles[vehicle].images.cameras[camera].failed(slot.counted);
                let name = &hub.vehicles[vehicle].name;
                warn!("{name}: camera {camera}: {error:#}; image {} is skipped", slot.seq);
            }
        }
        ticks.pass_on(tick, hub.outlet.viewers() > 0);
    }
}

/// Encoder and scratch memory.
struct Stage {
    encoder: Encoder,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
}

impl Stage {
    fn new(options: EncodeOptions) -> Self {
        Self { encoder: Encoder::new(options), rgb: Vec::new(), depth_mm: Vec::new() }
    }

    /// Encodes the image of `slot` and hands it over; `together` are the cameras of its vehicle
    /// that are sent with it, as bits.
    fn encode(&mut self, hub: &Hub, slot: &DrawnImage, together: u32) -> Result<()> {
        let (Some(set), Some(world_from_body)) = (&slot.set, slot.world_from_body) else {
            return Ok(());
        };
        let (vehicle, camera) = (slot.vehicle, slot.camera);
        let (info, image) = (&set.infos[camera], &slot.image);
        image.write_rgb8(&mut self.rgb);
        image.write_depth_mm(DepthKind::Median, &mut self.depth_mm);
        let _span = trace_span!("encode", seq = slot.seq, camera).entered();
        let start = clock::now();
        let mut header = ImageHeader::new(
            slot.seq,
            camera as u8,
            slot.pose,
            &info.intrinsics,
            &info.body_from_cam,
            &world_from_body,
        );
        header.together = together.into();
        header.render_start_ns = slot.render_start.as_ns().into();
        header.render_end_ns = slot.render_end.as_ns().into();
        let mut payload = hub.outlet.buffer();
        let view = RgbdView {
            width: image.width_px,
            height: image.height_px,
            rgb: &self.rgb,
            depth_mm: &self.depth_mm,
        };
        self.encoder.encode(&view, &mut payload).context("cannot encode")?;
        let end = clock::now();
        header.payload_len = (payload.len() as u32).into();
        header.encode_end_ns = end.as_ns().into();
        hub.stats.encode.add(start, end);
        if hub.outlet.send(Outgoing { vehicle, camera, header, payload }) {
            hub.vehicles[vehicle].images.cameras[camera].handed(slot.counted);
        }
        Ok(())
    }
}

/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);
