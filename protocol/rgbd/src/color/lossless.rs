//! Lossless colour: green, red minus green, and blue minus green, each as an entropy-coded plane.

use super::jpeg::damaged;
use crate::error::DecodeError;
use crate::plane::{PlaneDecoder, PlaneEncoder, Samples};

/// Encodes slices. Owns the scratch memory.
#[derive(Clone, Debug, Default)]
pub(crate) struct LosslessEncoder {
    plane: PlaneEncoder,
    samples: Vec<u16>,
    bytes: Vec<u8>,
}

impl LosslessEncoder {
    /// Appends three planes, each after its length, to `out`.
    pub(crate) fn encode(&mut self, rgb: &[u8], width: usize, out: &mut Vec<u8>) {
        for channel in [1, 0, 2] {
            self.samples.clear();
            self.samples.extend(rgb.as_chunks::<3>().0.iter().map(|pixel| {
                let less = if channel == 1 { 0 } else { pixel[1] };
                u16::from(pixel[channel].wrapping_sub(less))
            }));
            self.bytes.clear();
            self.plane.encode(&self.samples, width, Samples::Bytes, &mut self.bytes);
            out.extend_from_slice(&(self.bytes.len() as u32).to_le_bytes());
            out.extend_from_slice(&self.bytes);
        }
    }
}

/// Decodes slices. Owns the scratch memory.
#[derive(Clone, Debug, Default)]
pub(crate) struct LosslessDecoder {
    plane: PlaneDecoder,
    samples: Vec<u16>,
}

impl LosslessDecoder {
    /// Decodes a range of rows, H x W x 3.
    pub(crate) fn decode(
        &mut self,
        mut bytes: &[u8],
        width: usize,
        rgb_out: &mut [u8],
    ) -> Result<(), DecodeError> {
        for channel in [1, 0, 2] {
            let plane = take_plane(&mut bytes).ok_or_else(|| damaged("a plane is cut short"))?;
            self.samples.resize(rgb_out.len() / 3, 0);
            self.plane
                .decode(plane, width, Samples::Bytes, &mut self.samples)
                .ok_or_else(|| damaged("a plane's bits do not end where its pixels do"))?;
            for (pixel, &sample) in rgb_out.as_chunks_mut::<3>().0.iter_mut().zip(&self.samples) {
                let less = if channel == 1 { 0 } else { pixel[1] };
                pixel[channel] = (sample as u8).wrapping_add(less);
            }
        }
        if bytes.is_empty() { Ok(()) } else { Err(damaged("bytes follow the last plane")) }
    }
}

fn take_plane<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (len, rest) = bytes.split_first_chunk::<4>()?;
    let (plane, rest) = rest.split_at_checked(u32::from_le_bytes(*len) as usize)?;
    *bytes = rest;
    Some(plane)
}
