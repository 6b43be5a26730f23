//! Decoder of `.ksplat`: bytes to splats.

use glam::Vec3;
use half::f16;

use super::{
    BUCKET_BYTES, DEFAULT_HARMONIC, DEFAULT_RANGE, HEADER_BYTES, Row, SECTION_BYTES, harmonic_index,
};
use crate::format::activate::harmonic_of_colour;
use crate::format::block::{Gaussian, decode_all};
use crate::format::bytes::{f32_at, u16_at, u32_at};
use crate::format::progress::Meter;
use crate::format::{Format, FormatError, Loaded, limit};

/// Section that was checked to be within the file.
struct Section<'a> {
    /// Index of its first splat in the scene.
    first: usize,
    count: usize,
    sh_degree: u8,
    /// Size of one splat. [byte]
    stride: usize,
    rows: &'a [u8],
    buckets: Buckets<'a>,
}

/// Buckets of a section: the bucket of each splat, and the position of each bucket.
struct Buckets<'a> {
    /// Splats per full bucket.
    capacity: usize,
    /// Splats in all full buckets.
    full_splats: usize,
    full: usize,
    /// For each partial bucket, the index after its last splat, counted from the first partial
    /// bucket.
    partial_ends: Vec<usize>,
    centres: &'a [u8],
    /// Zero point of a coordinate's u16.
    range: f32,
    /// Length of one step of the u16. [m]
    step_m: f32,
}

/// Returns whether the bytes are a `.ksplat` file. There is no magic number, so the check compares
/// sizes.
pub(in crate::format) fn is_ksplat(bytes: &[u8]) -> bool {
    bytes.len() >= HEADER_BYTES + SECTION_BYTES
        && bytes[..4] == [0, 1, 0, 0]
        && (1..=u32_at(bytes, 4)).contains(&u32_at(bytes, 8))
        && (1..=u32_at(bytes, 12)).contains(&u32_at(bytes, 16))
        && u16_at(bytes, 20) <= 2
}

/// Reads the bytes of a `.ksplat` file.
pub(in crate::format) fn decode(bytes: &[u8], meter: &Meter) -> Result<Loaded, FormatError> {
    let truncated = |what, needed: u64| FormatError::Truncated {
        format: Format::Ksplat,
        what,
        needed,
        available: bytes.len() as u64,
    };
    let invalid = |at: usize, reason: String| FormatError::Invalid {
        format: Format::Ksplat,
        place: format!("byte {at}"),
        reason,
    };
    if bytes.len() < HEADER_BYTES {
        return Err(truncated("the header", HEADER_BYTES as u64));
    }
    if bytes[0] != 0 || bytes[1] < 1 {
        return Err(FormatError::Unsupported {
            format: Format::Ksplat,
            what: format!("version {}.{}", bytes[0], bytes[1]),
            advice: "save it with GaussianSplats3D 0.4, or as PLY",
        });
    }
    let level = usize::from(u16_at(bytes, 20));
    let Some(&row) = Row::LEVELS.get(level) else {
        return Err(invalid(20, format!("compression level {level}; expected 0 to 2")));
    };
    // A complete file contains all sections that it declares.
    let section_count = u32_at(bytes, 4) as usize;
    let mut at = HEADER_BYTES as u64 + section_count as u64 * SECTION_BYTES as u64;
    if at > bytes.len() as u64 {
        return Err(truncated("the section headers", at));
    }
    let mut sections = Vec::with_capacity(section_count);
    let mut count = 0;
    for section in 0..section_count {
        let head_at = HEADER_BYTES + section * SECTION_BYTES;
        let head = &bytes[head_at..head_at + SECTION_BYTES];
        let word = |at: usize| u64::from(u32_at(head, at));
        let (splats, room) = (word(0), word(4));
        if splats > room {
            return Err(invalid(head_at, format!("{splats} splats in a section of {room}")));
        }
        let sh_degree = u16_at(head, 40);
        if sh_degree > 3 {
            return Err(invalid(head_at + 40, format!("harmonics of degree {sh_degree}")));
        }
        let stride = row.bytes(sh_degree as u8);
        let (bucket_count, partial) = (word(12), word(36));
        let bucket_bytes = u64::from(u16_at(head, 20));
        let centres_at = at + partial * 4;
        let rows_at = centres_at + bucket_bytes * bucket_count;
        // Sums of products of 32-bit numbers are far below 2^64.
        let end = rows_at + stride as u64 * room;
        if end > bytes.len() as u64 {
            return Err(truncated("a section", end));
        }
        let buckets = Buckets {
            capacity: word(8) as usize,
            full_splats: (word(8) * word(32)).min(1 << 40) as usize,
            full: word(32) as usize,
            partial_ends: (0..partial as usize)
                .scan(0, |end, i| {
                    *end += u32_at(bytes, at as usize + i * 4) as usize;
                    Some(*end)
                })
                .collect(),
            centres: &bytes[centres_at as usize..rows_at as usize],
            range: match u32_at(head, 24) {
                0 => DEFAULT_RANGE as f32,
                range => range as f32,
            },
            step_m: 0.0,
        };
        let step_m = f32_at(head, 16) / 2.0 / buckets.range;
        let buckets = Buckets { step_m, ..buckets };
        if level > 0 && splats > 0 {
            let room = buckets.full_splats + buckets.partial_ends.last().copied().unwrap_or(0);
            if bucket_bytes != BUCKET_BYTES as u64
                || word(32) + partial > bucket_count
                || splats > room as u64
            {
                return Err(invalid(
                    head_at,
                    format!("{bucket_count} buckets do not hold {splats} splats"),
                ));
            }
        }
        let rows = &bytes[rows_at as usize..end as usize];
        let (first, splats) = (count, splats as usize);
        let sh_degree = sh_degree as u8;
        sections.push(Section { first, count: splats, sh_degree, stride, rows, buckets });
        count += splats;
        at = end;
    }
    limit::count(Format::Ksplat, count as u64)?;
    meter.expect(count);
    sections.retain(|section| section.count > 0);

    // Zero means that the writer did not set the bound.
    let bound = |at: usize, default: f32| match f32_at(bytes, at) {
        0.0 => default,
        bound => bound,
    };
    let (low, high) = (bound(36, -DEFAULT_HARMONIC), bound(40, DEFAULT_HARMONIC));
    let sh_degree = sections.iter().map(|section| section.sh_degree).max().unwrap_or(0);
    let (splats, dropped) = decode_all(sh_degree, count, meter, |first, block| {
        let mut at = sections.partition_point(|s| s.first + s.count <= first);
        for i in 0..block.len() {
            if first + i == sections[at].first + sections[at].count {
                at += 1;
            }
            let section = &sections[at];
            let index = first + i - section.first;
            let bytes = &section.rows[index * section.stride..][..section.stride];
            let number = |at: usize, i: usize| match level {
                0 => f32_at(bytes, at + i * 4),
                _ => f16::from_bits(u16_at(bytes, at + i * 2)).to_f32(),
            };
            let mean_m = match level {
                0 => Vec3::new(number(0, 0), number(0, 1), number(0, 2)),
                _ => section.buckets.position_m(index, bytes),
            };
            let [w, x, y, z] = [0, 1, 2, 3].map(|i| number(row.rotation, i));
            let colour = |channel: usize| f32::from(bytes[row.colour + channel]) / 255.0;
            let gaussian = Gaussian {
                mean_m,
                scale_m: Vec3::from_array([0, 1, 2].map(|i| number(row.scale, i))),
                rotation_xyzw: [x, y, z, w],
                opacity: colour(3),
            };
            let kept = (usize::from(section.sh_degree) + 1).pow(2);
            block.put(i, &gaussian, |k, channel| match k {
                0 => harmonic_of_colour(colour(channel)),
                _ if k >= kept => 0.0,
                _ => {
                    let i = harmonic_index(k, channel);
                    match level {
                        2 => low + (high - low) * f32::from(bytes[row.harmonics + i]) / 255.0,
                        _ => number(row.harmonics, i),
                    }
                }
            });
        }
    });
    Loaded::whole(Format::Ksplat, count, splats, dropped)
}

impl Buckets<'_> {
    /// Returns the position of a splat from the start of its row. [m]
    fn position_m(&self, index: usize, row: &[u8]) -> Vec3 {
        let bucket = match index.checked_sub(self.full_splats) {
            None => index / self.capacity,
            Some(index) => self.full + self.partial_ends.partition_point(|&end| end <= index),
        };
        let axis = |i: usize| {
            (f32::from(u16_at(row, i * 2)) - self.range) * self.step_m
                + f32_at(self.centres, bucket * BUCKET_BYTES + i * 4)
        };
        Vec3::new(axis(0), axis(1), axis(2))
    }
}
