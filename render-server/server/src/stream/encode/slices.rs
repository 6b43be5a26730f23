//! Encoder of one rendered image, slice by slice: quantises and encodes a slice while earlier slices are being
//! sent.
//!
//! Budget at 640x480 in four slices: quantise 0.1 ms, encode 0.4 ms a slice, so the first bytes leave after a
//! quarter of the image's time. Each slice is quantised just before it is encoded, so that it is still in the
//! cache. Its bytes (25 KB) are copied once, from the encoder's scratch memory into a buffer of the pool, which
//! all subscribers share. In the steady state this module allocates no memory: a buffer is reused when the
//! transport has released its last byte.

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

/// Encodes rendered images for [`Subscriptions`]; owns the scratch memory.
#[derive(Debug)]
pub struct SliceEncoder {
    encoder: Encoder,
    options: EncodeOptions,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
    scratch: Vec<u8>,
    buffers: Vec<BytesMut>,
    /// Size of the largest image so far, with a reserve. [bytes]
    room: usize,
    broadcast: Broadcast,
}

impl SliceEncoder {
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

    /// Sets the options of the next image.
    pub fn set_options(&mut self, options: EncodeOptions) {
        self.options = options;
    }

    /// Encodes the image of `slot` and passes it on. `together` is a bit set of the vehicle's cameras that are
    /// sent to the runtime with it. Returns start and end of encoding; `None` if no subscriber has room.
    ///
    /// # Errors
    /// If the image cannot be encoded; subscribers that received a part of it reset it.
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

    /// If the depth is `withheld`, sends "no return" for every pixel. Plugins decode it like any other image,
    /// and it takes little space.
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
        // The header is sent with the first slice: a packet with only the header would wake the receiver for
        // nothing.
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

    /// Returns an unused buffer with room for the largest image so far.
    fn buffer(&mut self) -> BytesMut {
        let room = self.room;
        let free = self.buffers.iter_mut().position(|buffer| buffer.try_reclaim(room));
        free.map_or_else(|| BytesMut::with_capacity(room), |at| self.buffers.swap_remove(at))
    }
}

/// Minimum size of a slice. Each slice costs three wake-ups; below a quarter of 640x480 they cost more than the
/// overlap gains. [px]
const MIN_SLICE_PIXELS: u32 = 320 * 240;
/// Initial buffer size: a small image. The encoder adapts it to larger images. [bytes]
const MIN_BUFFER: usize = 64 << 10;
/// Enough for eight cameras of four vehicles with two images each in flight.
const MAX_BUFFERS: usize = 64;
