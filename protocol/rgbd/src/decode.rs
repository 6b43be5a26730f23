//! Decoding: an image at once, as its bytes arrive, or slice by slice in any order.

use core::ops::Range;

use crate::color::{JpegSliceDecoder, LosslessDecoder};
use crate::depth::DepthDecoder;
use crate::depth::bound::Levels;
use crate::error::DecodeError;
use crate::header::{
    ColorMode, DepthMode, HEADER_BYTES, Info, SLICE_HEADER_BYTES, peek, slice_len, split_slice,
};
use crate::ids;
use crate::image::ImageMut;
use crate::plane::{PlaneDecoder, Samples};

/// Decodes bitstreams to images. Owns the scratch memory, which grows with the caller's buffers and never by a value in
/// a header.
#[derive(Debug, Default)]
pub struct Decoder {
    /// Header of the present image.
    info: Option<Info>,
    /// One bit per decoded slice.
    done: u64,
    /// Number of bytes of the image that [`Self::feed`] has decoded.
    consumed: usize,
    jpeg: JpegSliceDecoder,
    lossless: LosslessDecoder,
    depth: DepthDecoder,
    plane: PlaneDecoder,
    levels: Option<Levels>,
    samples: Vec<u16>,
}

/// Progress of [`Decoder::feed`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Rows decoded by this call, of one or more slices.
    pub rows: Range<u32>,
    /// Whether all slices are decoded.
    pub complete: bool,
}

impl Decoder {
    /// Makes a decoder without scratch memory.
    pub fn new() -> Self {
        Self::default()
    }

    /// Decodes an image into the caller's buffers: H x W x 3 colour and H x W depth [mm]. An empty buffer skips its
    /// part. Sizes are checked before any pixel is written. After a later error the buffers contain a part of the
    /// image.
    ///
    /// # Errors
    /// Every [`DecodeError`]. Time and memory are bounded by the lengths of the bytes and the buffers.
    pub fn decode(
        &mut self,
        bytes: &[u8],
        rgb_out: &mut [u8],
        depth_out: &mut [u16],
    ) -> Result<(), DecodeError> {
        let mut out = ImageMut { rgb: rgb_out, depth_mm: depth_out, ..ImageMut::default() };
        self.decode_image(bytes, &mut out)
    }

    /// Decodes an image with any parts into the caller's buffers. See [`Self::decode`].
    ///
    /// # Errors
    /// Every [`DecodeError`]. Time and memory are bounded by the lengths of the bytes and the buffers.
    pub fn decode_image(
        &mut self,
        bytes: &[u8],
        out: &mut ImageMut<'_>,
    ) -> Result<(), DecodeError> {
        self.restart();
        let info = peek(bytes)?;
        let progress = self.feed(bytes, out)?;
        if progress.complete && self.consumed == bytes.len() {
            return Ok(());
        }
        let next = bytes.get(self.consumed..).and_then(slice_len).filter(|_| !progress.complete);
        let least = self.consumed.max(info.header_len) as u64;
        let expected = least + next.unwrap_or(0);
        Err(DecodeError::Length { expected, found: bytes.len() })
    }

    /// Discards the present image, to begin the next one.
    pub fn restart(&mut self) {
        (self.info, self.done, self.consumed) = (None, 0, 0);
    }

    /// Decodes all slices that are complete and not yet decoded. `received` are all bytes of the image received until
    /// now, from its first. Call [`Self::restart`] before the next image.
    ///
    /// # Errors
    /// Every [`DecodeError`] except [`DecodeError::Length`], because more bytes may arrive. After an error the image
    /// cannot be decoded further.
    pub fn feed(
        &mut self,
        received: &[u8],
        out: &mut ImageMut<'_>,
    ) -> Result<Progress, DecodeError> {
        let mut progress = Progress { rows: 0..0, complete: false };
        if self.info.is_none() {
            if received.len() < HEADER_BYTES {
                return Ok(progress);
            }
            let info = peek(received)?;
            check_room(&info, out)?;
            if received.len() < info.header_len {
                return Ok(progress);
            }
            self.start(received)?;
            self.consumed = info.header_len;
        }
        while !self.is_complete() {
            let rest = received.get(self.consumed..).unwrap_or(&[]);
            let Some(len) = slice_len(rest) else { break };
            let Some(slice) = usize::try_from(len).ok().and_then(|len| rest.get(..len)) else {
                break;
            };
            let rows = self.push_slice(slice, out)?;
            progress.rows = if progress.rows.is_empty() {
                rows
            } else {
                progress.rows.start.min(rows.start)..progress.rows.end.max(rows.end)
            };
            self.consumed += slice.len();
        }
        progress.complete = self.is_complete();
        Ok(progress)
    }

    /// Begins an image. `bytes` must contain its whole header ([`Info::header_len`]).
    ///
    /// # Errors
    /// Errors of [`peek`], and [`DecodeError::Color`] for invalid JPEG tables.
    pub fn start(&mut self, bytes: &[u8]) -> Result<Info, DecodeError> {
        self.restart();
        let info = peek(bytes)?;
        let tables =
            bytes.get(HEADER_BYTES..info.header_len).ok_or(DecodeError::Short(bytes.len()))?;
        if matches!(info.color, Some(ColorMode::Jpeg444 | ColorMode::Jpeg420)) {
            self.jpeg.start(tables, info.width)?;
        }
        self.info = Some(info);
        Ok(info)
    }

    /// Decodes one complete slice after [`Self::start`]; slices may arrive in any order. Returns the decoded rows.
    ///
    /// # Errors
    /// Every [`DecodeError`] about slices, parts and buffers.
    pub fn push_slice(
        &mut self,
        slice: &[u8],
        out: &mut ImageMut<'_>,
    ) -> Result<Range<u32>, DecodeError> {
        let parts = split_slice(slice)?;
        let index = parts.index;
        let info = self.info.ok_or(DecodeError::Slice(index))?;
        check_room(&info, out)?;
        if index >= u16::from(info.slices) || self.done >> index & 1 == 1 {
            return Err(DecodeError::Slice(index));
        }
        for (name, present, bytes) in [
            ("colour", info.color.is_some(), parts.color),
            ("depth", info.depth.is_some(), parts.depth),
            ("alpha", info.has_alpha, parts.alpha),
            ("ids", info.has_ids, parts.ids),
        ] {
            if !present && !bytes.is_empty() {
                return Err(DecodeError::Mode(name, 0));
            }
        }
        let rows = info.slice_rows(index as u8);
        let width = info.width as usize;
        let pixels = rows.start as usize * width..rows.end as usize * width;
        if !out.depth_mm.is_empty() {
            self.depth(&info, parts.depth, &mut out.depth_mm[pixels.clone()])?;
        }
        if !out.rgb.is_empty() {
            let rgb = &mut out.rgb[3 * pixels.start..3 * pixels.end];
            if info.color == Some(ColorMode::Lossless) {
                self.lossless.decode(parts.color, width, rgb)?;
            } else {
                self.jpeg.decode(parts.color, (info.width, rows.len() as u32), rgb)?;
            }
        }
        if !out.alpha.is_empty() {
            self.samples.resize(pixels.len(), 0);
            self.plane
                .decode(parts.alpha, width, Samples::Bytes, &mut self.samples)
                .ok_or(DecodeError::Plane("alpha"))?;
            for (value, &sample) in out.alpha[pixels.clone()].iter_mut().zip(&self.samples) {
                *value = sample as u8;
            }
        }
        if !out.ids.is_empty() {
            ids::decode(parts.ids, width, &mut out.ids[pixels])?;
        }
        self.done |= 1 << index;
        Ok(rows)
    }

    /// Returns whether every slice of the present image is decoded.
    pub fn is_complete(&self) -> bool {
        self.info.is_some_and(|info| self.done.count_ones() == u32::from(info.slices))
    }

    fn depth(&mut self, info: &Info, bytes: &[u8], out: &mut [u16]) -> Result<(), DecodeError> {
        let width = info.width as usize;
        match info.depth {
            Some(DepthMode::Fast) => self.depth.decode(bytes, width, out)?,
            Some(DepthMode::Small) => self
                .plane
                .decode(bytes, width, Samples::Masked, out)
                .ok_or(DecodeError::Plane("depth"))?,
            None => {}
        }
        if let Some(bound) = info.depth_bound {
            Levels::cached(&mut self.levels, bound).restore(out);
        }
        Ok(())
    }
}

/// Checks that every buffer is empty or has the size of its part.
fn check_room(info: &Info, out: &ImageMut<'_>) -> Result<(), DecodeError> {
    let &Info { width, height, .. } = info;
    let pixels = width as usize * height as usize;
    for (part, found, present, expected) in [
        ("colour", out.rgb.len(), info.color.is_some(), 3 * pixels),
        ("depth", out.depth_mm.len(), info.depth.is_some(), pixels),
        ("alpha", out.alpha.len(), info.has_alpha, pixels),
        ("ids", out.ids.len(), info.has_ids, pixels),
    ] {
        let expected = if present { expected } else { 0 };
        if found != 0 && found != expected {
            return Err(DecodeError::Room { part, found, expected, width, height });
        }
    }
    Ok(())
}

const _: () = assert!(SLICE_HEADER_BYTES == 20 && HEADER_BYTES == 20);
