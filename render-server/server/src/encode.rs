//! The encode thread: drawn ticks in, image packets and previews out.
//!
//! Waits for room in the [`Outlet`](crate::outlet), then takes the newest drawn tick: what was
//! drawn meanwhile is skipped unencoded. Per image of 320x240: quantise 0.1 ms, encode about
//! 2 ms; buffers circulate, nothing of ours is allocated in the steady state. Previews cost about as
//! much again, at most [`PREVIEW_HZ`] times a second, and only while a page is open.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use tracing::{trace_span, warn};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView, encode_jpeg};
use vizflyt_splat::{DepthKind, RgbdImage};

use crate::cameras::CameraSet;
use crate::clock;
use crate::hub::{Hub, MAX_VEHICLES};
use crate::mailbox::Mailbox;
use crate::outlet::Outgoing;
use crate::vehicle::Vehicle;

/// What was drawn in one tick, and what nobody took of the ticks it replaced; reused from tick to
/// tick.
#[derive(Debug, Default)]
pub struct DrawnTick {
    /// One per camera, vehicle by vehicle.
    pub slots: Vec<DrawnImage>,
}

/// The newest image of one camera.
#[derive(Debug, Default)]
pub struct DrawnImage {
    /// Whether there is one; everything else counts only then.
    pub fresh: bool,
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index into the vehicle's cameras.
    pub camera: usize,
    /// Its tick, counted from 1.
    pub seq: u64,
    /// When the pose was measured.
    pub pose: ServerTime,
    /// The pose drawn from.
    pub world_from_body: Option<Pose<World, Body>>,
    /// The vehicle's cameras as they were drawn with.
    pub set: Option<Arc<CameraSet>>,
    /// Rendering of the tick began.
    pub render_start: ServerTime,
    /// Rendering of the tick ended.
    pub render_end: ServerTime,
    /// The image.
    pub image: RgbdImage,
}

impl DrawnTick {
    /// Takes over the images of `old`, which it replaces unread, of cameras that were not due
    /// again: else a slow camera's images would be lost to a busy encoder.
    pub fn inherit(&mut self, old: &mut Self) {
        for (mine, theirs) in self.slots.iter_mut().zip(&mut old.slots) {
            if theirs.fresh && !mine.fresh {
                std::mem::swap(mine, theirs);
            }
        }
    }
}

impl DrawnImage {
    /// Whether its camera has fewer images than the page shows.
    fn is_slow(&self) -> bool {
        let rate_hz = self.set.as_ref().and_then(|set| set.configs[self.camera].rate_hz);
        rate_hz.is_some_and(|hz| hz < f64::from(PREVIEW_HZ))
    }
}

/// Two small pictures for the page.
#[derive(Debug)]
pub struct Preview {
    /// JPEG of the colour image.
    pub colour: Vec<u8>,
    /// JPEG of the depth image, coloured by [`depth_colour`].
    pub depth: Vec<u8>,
}

/// Encodes until the server stops.
pub fn run(hub: &Arc<Hub>, drawn: &Mailbox<DrawnTick>, options: EncodeOptions) {
    let mut stage = Stage::new(options);
    let mut preview_due = Instant::now();
    let mut order: Vec<usize> = Vec::new();
    while !hub.stop.is_set() {
        let wanted = hub.outlet.wait_for_room(preview_due, PATIENCE);
        if !wanted.anything() {
            continue;
        }
        let Some(tick) = drawn.take(PATIENCE) else { continue };
        if wanted.preview.contains(&true) {
            preview_due = Instant::now() + Duration::from_secs(1) / PREVIEW_HZ;
        }
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
            let stream = wanted.stream[vehicle][camera].then_some(together[vehicle]);
            // A slow camera's images come too seldom to wait for the page's turn.
            let preview = wanted.preview[vehicle] || (hub.outlet.viewers() > 0 && slot.is_slow());
            if stream.is_none() && !preview {
                continue;
            }
            if let Err(error) = stage.encode(hub, slot, stream, preview) {
                let name = &hub.vehicles[vehicle].name;
                warn!("{name}: camera {camera}: {error:#}; image {} is skipped", slot.seq);
            }
        }
        drawn.recycle(tick);
    }
}

/// Encoder and scratch memory.
struct Stage {
    encoder: Encoder,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
    coloured: Vec<u8>,
    palette: Vec<[u8; 3]>,
}

impl Stage {
    fn new(options: EncodeOptions) -> Self {
        Self {
            encoder: Encoder::new(options),
            rgb: Vec::new(),
            depth_mm: Vec::new(),
            coloured: Vec::new(),
            palette: (0..PALETTE_SIZE).map(|k| depth_colour(palette_depth_mm(k))).collect(),
        }
    }

    fn encode(
        &mut self,
        hub: &Hub,
        slot: &DrawnImage,
        stream: Option<u32>,
        preview: bool,
    ) -> Result<()> {
        let (Some(set), Some(world_from_body)) = (&slot.set, slot.world_from_body) else {
            return Ok(());
        };
        let (vehicle, camera) = (slot.vehicle, slot.camera);
        let (info, image) = (&set.infos[camera], &slot.image);
        image.write_rgb8(&mut self.rgb);
        image.write_depth_mm(DepthKind::Median, &mut self.depth_mm);
        if let Some(together) = stream {
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
            hub.outlet.send(Outgoing { vehicle, camera, header, payload });
        }
        if preview {
            self.preview(&hub.vehicles[vehicle], image, camera)?;
        }
        Ok(())
    }

    fn preview(&mut self, vehicle: &Vehicle, image: &RgbdImage, camera: usize) -> Result<()> {
        let (width, height) = (image.width_px, image.height_px);
        self.coloured.clear();
        for &mm in &self.depth_mm {
            self.coloured.extend_from_slice(&self.palette[palette_index(mm)]);
        }
        let jpeg = |rgb: &[u8]| -> Result<Vec<u8>> {
            let mut out = Vec::new();
            encode_jpeg(rgb, width, height, PREVIEW_QUALITY, &mut out).context("no preview")?;
            Ok(out)
        };
        let preview = Preview { colour: jpeg(&self.rgb)?, depth: jpeg(&self.coloured)? };
        if let Some(slot) = vehicle.previews.get(camera) {
            slot.send_replace(Some(Arc::new(preview)));
        }
        Ok(())
    }
}

/// Returns the colour of a depth on the page: pale near, dark far by the logarithm from 0.3 to
/// 20 m; black where there is no return. The page's legend shows the same stops.
pub fn depth_colour(depth_mm: u16) -> [u8; 3] {
    if depth_mm == 0 {
        return [0; 3];
    }
    let share = (f32::from(depth_mm) / NEAR_MM).ln() / (FAR_MM / NEAR_MM).ln();
    let at = share.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    let index = (at as usize).min(STOPS.len() - 2);
    let t = at - index as f32;
    let mix = |a: u8, b: u8| (f32::from(a) + (f32::from(b) - f32::from(a)) * t).round() as u8;
    let (a, b) = (STOPS[index], STOPS[index + 1]);
    [mix(a[0], b[0]), mix(a[1], b[1]), mix(a[2], b[2])]
}

/// The palette is indexed by depth in steps of 16 mm, no return apart.
fn palette_index(mm: u16) -> usize {
    if mm == 0 { 0 } else { 1 + usize::from(mm >> 4) }
}

fn palette_depth_mm(index: usize) -> u16 {
    if index == 0 { 0 } else { (((index - 1) << 4) + 8) as u16 }
}

const PALETTE_SIZE: usize = 1 + (1 << 12);
const STOPS: [[u8; 3]; 5] =
    [[255, 244, 191], [255, 173, 79], [232, 72, 108], [125, 47, 147], [31, 24, 80]];
const NEAR_MM: f32 = 300.0;
const FAR_MM: f32 = 20_000.0;
/// Smooth enough to watch; half of the cost of a stream at 30 Hz. [Hz]
pub const PREVIEW_HZ: u32 = 15;
const PREVIEW_QUALITY: u8 = 80;
/// How long a stop may go unnoticed.
const PATIENCE: Duration = Duration::from_millis(100);

/// Counts a drawn tick; `skipped` says that it replaced one that nobody took.
pub(crate) fn count(hub: &Hub, skipped: bool) {
    hub.stats.ticks.fetch_add(1, Ordering::Relaxed);
    hub.stats.ticks_skipped.fetch_add(u64::from(skipped), Ordering::Relaxed);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_colours_run_from_pale_to_dark_and_no_return_is_black() {
        assert_eq!(depth_colour(0), [0; 3]);
        assert_eq!(depth_colour(300), STOPS[0]);
        assert_eq!(depth_colour(1), STOPS[0]);
        assert_eq!(depth_colour(u16::MAX), STOPS[4]);
        let light = |mm| depth_colour(mm).iter().map(|&c| u32::from(c)).sum::<u32>();
        let depths = [300u16, 600, 1200, 2400, 5000, 10_000, 20_000];
        assert!(depths.is_sorted_by_key(|&mm| std::cmp::Reverse(light(mm))));
    }

    #[test]
    fn a_slow_cameras_image_outlives_the_tick_it_was_drawn_in() {
        let slot = |seq, fresh| DrawnImage { fresh, seq, ..DrawnImage::default() };
        let mut old = DrawnTick { slots: vec![slot(7, true), slot(7, true), slot(3, false)] };
        let mut new = DrawnTick { slots: vec![slot(8, true), slot(1, false), slot(2, false)] };
        new.inherit(&mut old);
        let found: Vec<_> = new.slots.iter().map(|slot| (slot.seq, slot.fresh)).collect();
        assert_eq!(found, [(8, true), (7, true), (2, false)]);
    }

    #[test]
    fn the_palette_agrees_with_the_colours() {
        let palette: Vec<_> =
            (0..PALETTE_SIZE).map(|k| depth_colour(palette_depth_mm(k))).collect();
        for mm in 0..=u16::MAX {
            let (found, expected) = (palette[palette_index(mm)], depth_colour(mm));
            let off = found.iter().zip(expected).map(|(a, b)| a.abs_diff(b)).max();
            assert!(off.is_some_and(|off| off <= 8), "{mm} mm: {found:?} for {expected:?}");
        }
    }
}
