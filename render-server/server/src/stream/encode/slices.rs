//! One rendered image to bytes, slice by slice: quantise, encode, hand over, while what was handed over
//! before is on its way already.
//!
//! Budget at 640x480 in four slices: quantise 0.1 ms, encode 0.4 ms a slice, so
//! the first bytes leave after a quarter of the image's time. Each slice is quantised just before it
//! is encoded: it is still in the cache. Its bytes (25 KB) are copied once, from the encoder's
//! scratch memory into a buffer of the pool; all subscribers share that. In the steady state nothing
//! of ours is allocated: a buffer is used again when the transport has let go of its last byte.

use anyhow::{Context, Result};
use bytes::BytesMut;
use tracing::trace_span;
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{EncodeOptions, Encoder, ImageView, Parts};
use vizflyt_splat::{DepthKind, RgbdImage};

use crate::clock;
use crate::render::rendered::RenderedImage;
use crate::render::schedule::withholds_depth;
use crate::stream::subscriptions::{Broadcast, Subscriptions};

/// Turns rendered images into bytes for [`Subscriptions`]; owns the scratch memory.
#[derive(Debug)]
pub struct SliceEncoder {
    encoder: Encoder,
    options: EncodeOptions,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
    scratch: Vec<u8>,
    buffers: Vec<BytesMut>,
    /// The largest image so far, and some room. [bytes]
    room: usize,
    broadcast: Broadcast,
}

impl SliceEncoder {
    /// Makes an encoder.
    pub fn new(options: EncodeOptions) -> Self {
        Self {
            encoder: Encoder::new(options),
            options,
            rgb: Vec::new(),
            depth_mm: Vec::new(),
            scratch: Vec::new(),
            buffers: Vec::new(),
            room: MIN_BUFFER,
            broadcast: Broadcast::default(),
        }
    }

    /// Changes what the next image is encoded with.
    pub fn set_options(&mut self, options: EncodeOptions) {
        self.options = options;
    }

    /// Encodes the image of `slot` and hands it over; `together` are the cameras of its vehicle
    /// that are sent to the runtime with it, as bits. Returns when encoding began and ended; `None`
    /// if nobody has room.
    ///
    /// # Errors
    /// If the image cannot be encoded; whoever had some of it resets it.
    pub fn send(
        &mut self,
        subscriptions: &Subscriptions,
        slot: &RenderedImage,
        together: u32,
    ) -> Result<Option<(ServerTime, ServerTime)>> {
        let (Some(set), Some(world_from_body)) = (&slot.set, slot.world_from_body) else {
            return Ok(None);
        };
        let (camera, info) = (slot.camera, &set.infos[slot.camera]);
        let _span = trace_span!("encode", seq = slot.seq, camera).entered();
        let start = clock::now();
        let (k, body_from_cam) = (&info.intrinsics, &info.body_from_cam);
        let mut header =
            ImageHeader::new(slot.seq, camera as u8, slot.pose, k, body_from_cam, &world_from_body);
        header.exposure_ns = slot.shown.as_ns().into();
        header.together = together.into();
        header.render_start_ns = slot.render_start.as_ns().into();
        header.render_end_ns = slot.render_end.as_ns().into();
        let priority = set.configs[camera].priority;
        let to_runtime = together >> camera & 1 == 1;
        let way = (slot.vehicle, camera);
        subscriptions.begin(way, header, priority, to_runtime, &mut self.broadcast);
        if self.broadcast.is_empty() {
            return Ok(None);
        }
        let withheld = withholds_depth(&set.configs[camera]);
        let result = self.slices(&slot.image, withheld).context("cannot encode");
        let end = clock::now();
        subscriptions.end(&mut self.broadcast, result.is_ok().then_some(end));
        result.map(|()| Some((start, end)))
    }

    /// Depth that is `withheld` is sent as "no return" everywhere: for plugins that is an image like
    /// any other, and it takes no room.
    fn slices(
        &mut self,
        image: &RgbdImage,
        withheld: bool,
    ) -> Result<(), vizflyt_rgbd::EncodeError> {
        let parts = Parts { color: true, depth: true, ..Parts::default() };
        let (width, height) = (image.width_px, image.height_px);
        let mut buffer = self.buffer();
        let mut len = 0;
        self.scratch.clear();
        let slices = (width * height / MIN_SLICE_PIXELS).clamp(1, self.options.slices.into());
        self.encoder.set_options(EncodeOptions { slices: slices as u8, ..self.options });
        // The header leaves with the first slice: alone it would only wake the other end.
        let info = self.encoder.start(width, height, parts, &mut self.scratch)?;
        for slice in 0..info.slices {
            let rows = info.slice_rows(slice);
            image.write_rgb8_rows(rows.clone(), &mut self.rgb);
            image.write_depth_mm_rows(DepthKind::Median, rows.clone(), &mut self.depth_mm);
            if withheld {
                self.depth_mm.fill(0);
            }
            let view = ImageView {
                width,
                height: rows.end - rows.start,
                rgb: &self.rgb,
                depth_mm: &self.depth_mm,
                ..ImageView::default()
            };
            self.encoder.push_slice(&view, &mut self.scratch)?;
            buffer.extend_from_slice(&self.scratch);
            len += self.scratch.len();
            self.scratch.clear();
            self.broadcast.push(&buffer.split().freeze());
        }
        if len > self.room {
            self.room = (len + len / 4).next_power_of_two();
        }
        if self.buffers.len() < MAX_BUFFERS {
            self.buffers.push(buffer);
        }
        Ok(())
    }

    /// Returns a buffer that nobody holds any part of, with room for the largest image so far.
    fn buffer(&mut self) -> BytesMut {
        let room = self.room;
        let free = self.buffers.iter_mut().position(|buffer| buffer.try_reclaim(room));
        free.map_or_else(|| BytesMut::with_capacity(room), |at| self.buffers.swap_remove(at))
    }
}

/// A slice is three wake-ups on its way: below a quarter of 640x480 they cost more than the overlap
/// gains. [px]
const MIN_SLICE_PIXELS: u32 = 320 * 240;
/// A small image; larger ones teach the encoder their size. [bytes]
const MIN_BUFFER: usize = 64 << 10;
/// Eight cameras of four vehicles with two images each in flight.
const MAX_BUFFERS: usize = 64;
