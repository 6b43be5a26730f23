//! Decoder of baseline JPEG (ITU-T T.81) for slices: one scan at a time, directly from the slice's bytes to the
//! caller's rows.
//!
//! Unlike other decoders, which fill missing pixels with grey, this one returns an error. A scan contains its pixels,
//! less than a byte of padding, and nothing else.

#![allow(
    unsafe_code,
    reason = "calls of functions compiled for more instructions, after detection"
)]

mod entropy;
mod tables;
#[cfg(test)]
mod tests;
mod transform;

use super::jpeg::{END_OF_IMAGE, damaged};
use crate::error::DecodeError;
use entropy::Bits;
use tables::Tables;
use transform::Sample;

/// Decodes slices. Owns the scratch memory.
#[derive(Debug, Default)]
pub(crate) struct JpegSliceDecoder {
    /// Bytes from which `tables` were parsed.
    bytes: Vec<u8>,
    tables: Option<Box<Tables>>,
    scratch: Scratch,
}

/// Samples before colour conversion.
#[derive(Debug, Default)]
struct Scratch {
    /// Y, Cb and Cr: two rows of coding units, used alternately.
    planes: [Vec<Sample>; 3],
    /// Rows of Cb and Cr at full resolution.
    doubled: [Vec<Sample>; 2],
    sums: Vec<u16>,
}

impl JpegSliceDecoder {
    /// Sets the tables of the next image.
    pub(crate) fn start(&mut self, tables: &[u8], width: u32) -> Result<(), DecodeError> {
        if self.tables.is_none() || self.bytes != tables {
            self.tables = None;
            let read = Tables::read(tables).map_err(damaged)?;
            self.tables = Some(Box::new(read));
            self.bytes.clear();
            self.bytes.extend_from_slice(tables);
        }
        let found = self.tables.as_ref().map_or(0, |tables| tables.width);
        if u32::from(found) != width {
            self.tables = None;
            return Err(damaged(&format!("its tables are for a width of {found}, not {width}")));
        }
        Ok(())
    }

    /// Decodes a range of rows, H x W x 3.
    pub(crate) fn decode(
        &mut self,
        scan: &[u8],
        (width, height): (u32, u32),
        rgb_out: &mut [u8],
    ) -> Result<(), DecodeError> {
        let tables = self.tables.as_deref().ok_or_else(|| damaged("it has no tables"))?;
        let width = width as usize;
        if width != usize::from(tables.width) || rgb_out.len() != 3 * width * height as usize {
            return Err(damaged("its tables are for another size"));
        }
        let entropy = scan.strip_suffix(&END_OF_IMAGE);
        let entropy = entropy.ok_or_else(|| damaged("a scan lacks its end"))?;
        decode_scan(tables, &mut self.scratch, entropy, rgb_out).map_err(damaged)
    }
}

/// Runs [`decode_scan_here`] with AVX2 if available, otherwise with the base instruction set: the same code, compiled
/// twice.
fn decode_scan(
    tables: &Tables,
    scratch: &mut Scratch,
    scan: &[u8],
    rgb_out: &mut [u8],
) -> Result<(), &'static str> {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
        fn wide(
            tables: &Tables,
            scratch: &mut Scratch,
            scan: &[u8],
            rgb_out: &mut [u8],
        ) -> Result<(), &'static str> {
            decode_scan_here(tables, scratch, scan, rgb_out)
        }
        if is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("lzcnt")
            && is_x86_feature_detected!("popcnt")
        {
            // SAFETY: the machine supports the features for which the function is compiled.
            return unsafe { wide(tables, scratch, scan, rgb_out) };
        }
    }
    decode_scan_here(tables, scratch, scan, rgb_out)
}

#[inline(always)]
fn decode_scan_here(
    tables: &Tables,
    scratch: &mut Scratch,
    scan: &[u8],
    rgb_out: &mut [u8],
) -> Result<(), &'static str> {
    let (width, halving) = (usize::from(tables.width), tables.halving);
    let height = rgb_out.len() / (3 * width);
    // Size of a coding unit (A.2.3), in luma samples of each direction.
    let side = 8 * halving;
    let groups = width.div_ceil(side);
    let stride = (groups * side).next_multiple_of(transform::GROUP);
    for (plane, rows) in scratch.planes.iter_mut().zip([side, 8, 8]) {
        plane.resize(2 * rows * stride, 0);
    }
    // Component, and its block in the unit: column and row.
    let blocks = [(0, 0, 0), (0, 1, 0), (0, 0, 1), (0, 1, 1), (1, 0, 0), (2, 0, 0)];
    let blocks_444 = [blocks[0], blocks[4], blocks[5]];
    let blocks: &[_] = if halving == 1 { &blocks_444 } else { &blocks };

    let mut bits = Bits::new(scan);
    let mut dc = [0; 3];
    let mut done = 0;
    for row in 0..height.div_ceil(side) {
        for group in 0..groups {
            for &(component, column, down) in blocks {
                let of = &tables.components[component];
                let coded = bits.block(tables.prefixes(of), &of.basis, &mut dc[component])?;
                let samples = transform::samples(&coded);
                let across = if component == 0 { halving } else { 1 };
                let top = 8 * (row % 2 * across + down);
                let mut start = top * stride + 8 * (group * across + column);
                let plane = &mut scratch.planes[component];
                for samples in &samples {
                    plane[start..start + 8].copy_from_slice(samples);
                    start += stride;
                }
            }
        }
        // Chroma of the last row is smoothed with the next row of units.
        let decoded = (row + 1) * side;
        let ready = if decoded >= height { height } else { decoded + 1 - halving };
        for y in done..ready {
            let out = &mut rgb_out[3 * width * y..3 * width * (y + 1)];
            write_row(tables, scratch, stride, (y, height), out);
        }
        done = ready;
    }
    bits.finish()
}

/// Converts row y of an image with this height to pixels.
#[inline(always)]
fn write_row(
    tables: &Tables,
    scratch: &mut Scratch,
    stride: usize,
    (y, height): (usize, usize),
    rgb_out: &mut [u8],
) {
    let Scratch { planes, doubled, sums } = scratch;
    let plane_row = |plane: usize, y: usize| {
        let rows = if plane == 0 { 16 * tables.halving } else { 16 };
        &planes[plane][y % rows * stride..][..stride]
    };
    let luma = plane_row(0, y);
    if tables.halving == 1 {
        return transform::color_row(luma, plane_row(1, y), plane_row(2, y), rgb_out);
    }
    let near = y / 2;
    let far = if y % 2 == 0 { near.saturating_sub(1) } else { (near + 1).min((height - 1) / 2) };
    let len = usize::from(tables.width).div_ceil(2);
    sums.resize(len + 2, 0);
    for (plane, out) in [1, 2].into_iter().zip(&mut *doubled) {
        out.resize(stride, 0);
        let (near, far) = (&plane_row(plane, near)[..len], &plane_row(plane, far)[..len]);
        transform::double_row(near, far, sums, out);
    }
    transform::color_row(luma, &doubled[0], &doubled[1], rgb_out);
}
