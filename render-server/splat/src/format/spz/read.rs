//! Decoder of `.spz`: bytes to splats.

use std::f32::consts::SQRT_2;
use std::io::Read;

use flate2::bufread::GzDecoder;
use glam::Vec3;
use half::f16;
use ruzstd::decoding::StreamingDecoder;

use super::{
    COLOUR_SCALE, FLAG_ANTIALIASED, FLAG_EXTENSIONS, GZIP_MAGIC, HARMONIC_SIGNS, MAGIC, Widths,
};
use crate::Splats;
use crate::format::block::{DropCounts, Gaussian, decode_all};
use crate::format::bytes::{u16_at, u32_at};
use crate::format::progress::Meter;
use crate::format::{Format, FormatError, Loaded, limit};

/// Size of the header of versions 1 to 3, and of the common start of version 4's header. [byte]
const HEADER_BYTES: usize = 16;
/// Size of version 4's header. [byte]
const HEADER_4_BYTES: usize = 32;
/// Size of an entry of version 4's table of contents: packed and inflated size, u64 each. [byte]
const ENTRY_BYTES: usize = 16;
/// Maximum size of vendor-specific records after the attributes, which are inflated to reach the
/// checksum. [byte]
const MAX_TRAILER_BYTES: u64 = 1 << 20;
/// Zstd window that is accepted for any stream. Longer windows are accepted only for longer
/// attributes. [byte]
const FREE_WINDOW_BYTES: u64 = 8 << 20;

/// Header of a file.
struct Header {
    version: u32,
    count: usize,
    /// Degree as in the file, 0 to 4.
    sh_degree: u8,
    fractional_bits: u8,
    flags: u8,
}

/// Inflated attributes, in the order of [`Widths::in_order`].
type Attributes = [Vec<u8>; 6];

/// Reads the bytes of a `.spz` file.
pub(in crate::format) fn decode(bytes: &[u8], meter: &Meter) -> Result<Loaded, FormatError> {
    let (header, attributes) =
        if bytes.starts_with(&GZIP_MAGIC) { inflate(bytes, meter)? } else { unpack(bytes, meter)? };
    let (splats, dropped) = decode_attributes(&header, &attributes, meter);
    let mut loaded = Loaded::whole(Format::Spz, header.count, splats, dropped)?;
    loaded.splats.antialiased = header.flags & FLAG_ANTIALIASED != 0;
    if header.sh_degree > 3 {
        loaded.skipped_properties.push("harmonics of degree 4".into());
    }
    if header.flags & FLAG_EXTENSIONS != 0 {
        loaded.skipped_properties.push("extensions".into());
    }
    Ok(loaded)
}

/// Parses the first 16 bytes. All versions share them, except for the last byte.
fn parse_header(bytes: &[u8]) -> Result<Header, FormatError> {
    let invalid = |place: &str, reason: String| FormatError::Invalid {
        format: Format::Spz,
        place: place.into(),
        reason,
    };
    if u32_at(bytes, 0) != MAGIC {
        return Err(invalid("byte 0", "the header does not start with `NGSP`".into()));
    }
    let header = Header {
        version: u32_at(bytes, 4),
        count: u32_at(bytes, 8) as usize,
        sh_degree: bytes[12],
        fractional_bits: bytes[13],
        flags: bytes[14],
    };
    if !(1..=4).contains(&header.version) {
        return Err(FormatError::Unsupported {
            format: Format::Spz,
            what: format!("version {}", header.version),
            advice: "save it as version 4 or earlier, or as PLY",
        });
    }
    if header.sh_degree > 4 {
        return Err(invalid("byte 12", format!("harmonics of degree {}", header.sh_degree)));
    }
    if header.fractional_bits > 24 {
        let bits = header.fractional_bits;
        return Err(invalid("byte 13", format!("{bits} fractional bits of a 24-bit number")));
    }
    Ok(header)
}

/// Checks the inflated size against the size of the file, and reports the amount of work.
fn check_size(header: &Header, file_bytes: usize, meter: &Meter) -> Result<(), FormatError> {
    let each: usize = Widths::of(header.version, header.sh_degree).in_order().iter().sum();
    limit::inflated(Format::Spz, header.count as u64, each as u64, file_bytes)?;
    // One pass to inflate, reported in sixths, and one to decode.
    meter.expect(header.count * 7);
    Ok(())
}

/// Inflates versions 1 to 3.
fn inflate(bytes: &[u8], meter: &Meter) -> Result<(Header, Attributes), FormatError> {
    let mut stream = GzDecoder::new(bytes);
    let damaged = |error: std::io::Error| FormatError::Invalid {
        format: Format::Spz,
        place: "gzip stream".into(),
        reason: error.to_string(),
    };
    let mut start = [0; HEADER_BYTES];
    stream.read_exact(&mut start).map_err(damaged)?;
    let header = parse_header(&start)?;
    if header.version == 4 {
        return Err(FormatError::Invalid {
            format: Format::Spz,
            place: "byte 4".into(),
            reason: "version 4 is not one gzip stream".into(),
        });
    }
    check_size(&header, bytes.len(), meter)?;
    let mut attributes = Attributes::default();
    let widths = Widths::of(header.version, header.sh_degree).in_order();
    for (attribute, width) in attributes.iter_mut().zip(widths) {
        fill(&mut stream, attribute, header.count * width, damaged)?;
        meter.add(header.count);
    }
    // The checksum is at the end of the stream.
    let trailer = std::io::copy(&mut stream.take(MAX_TRAILER_BYTES), &mut std::io::sink());
    trailer.map_err(damaged)?;
    Ok((header, attributes))
}

/// Unpacks version 4.
fn unpack(bytes: &[u8], meter: &Meter) -> Result<(Header, Attributes), FormatError> {
    let truncated = |what, needed: u64| FormatError::Truncated {
        format: Format::Spz,
        what,
        needed,
        available: bytes.len() as u64,
    };
    if bytes.len() < HEADER_4_BYTES {
        return Err(truncated("the header", HEADER_4_BYTES as u64));
    }
    let header = parse_header(bytes)?;
    if header.version != 4 {
        return Err(FormatError::Invalid {
            format: Format::Spz,
            place: "byte 4".into(),
            reason: format!("version {} is not gzip-compressed", header.version),
        });
    }
    check_size(&header, bytes.len(), meter)?;
    let table = u32_at(bytes, 16) as usize;
    let streams = usize::from(bytes[15]);
    let mut at = table + streams * ENTRY_BYTES;
    if table < HEADER_4_BYTES || at > bytes.len() {
        return Err(truncated("the table of contents", at as u64));
    }
    // Positions, alphas, colours, scales, rotations, harmonics; the last is left out at degree 0.
    let widths = Widths::of(4, header.sh_degree).in_order();
    let mut attributes = Attributes::default();
    for (i, (attribute, width)) in attributes.iter_mut().zip(widths).enumerate() {
        let expected = header.count * width;
        let place = || format!("stream {i}");
        if i >= streams {
            if expected == 0 {
                continue;
            }
            return Err(FormatError::Invalid {
                format: Format::Spz,
                place: "byte 15".into(),
                reason: format!("{streams} streams, but there are 6 attributes"),
            });
        }
        let entry = table + i * ENTRY_BYTES;
        let size =
            |at: usize| u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32;
        let (packed, inflated) = (size(entry), size(entry + 8));
        if inflated != expected as u64 {
            return Err(FormatError::Invalid {
                format: Format::Spz,
                place: place(),
                reason: format!(
                    "{inflated} bytes for {} splats of {width} bytes each",
                    header.count
                ),
            });
        }
        let available = bytes.len() - at;
        if packed > available as u64 {
            return Err(truncated("an attribute", packed.saturating_add(at as u64)));
        }
        let packed = &bytes[at..at + packed as usize];
        at += packed.len();
        meter.add(header.count);
        if expected == 0 {
            continue;
        }
        let damaged = |error: &dyn std::fmt::Display| FormatError::Invalid {
            format: Format::Spz,
            place: place(),
            reason: error.to_string(),
        };
        let window = FREE_WINDOW_BYTES.max((expected as u64).next_power_of_two());
        let stream = StreamingDecoder::new_with_max_window_size(packed, window);
        let mut stream = stream.map_err(|error| damaged(&error))?;
        fill(&mut stream, attribute, expected, |error| damaged(&error))?;
    }
    Ok((header, attributes))
}

/// Reads exactly `length` bytes. The memory grows with the data, so a wrong declared length
/// allocates nothing.
fn fill(
    stream: &mut impl Read,
    out: &mut Vec<u8>,
    length: usize,
    damaged: impl Fn(std::io::Error) -> FormatError,
) -> Result<(), FormatError> {
    let read = stream.take(length as u64).read_to_end(out).map_err(damaged)?;
    if read < length {
        return Err(FormatError::Truncated {
            format: Format::Spz,
            what: "an attribute",
            needed: length as u64,
            available: read as u64,
        });
    }
    Ok(())
}

/// Decodes attributes of checked length to splats.
fn decode_attributes(
    header: &Header,
    attributes: &Attributes,
    meter: &Meter,
) -> (Splats, DropCounts) {
    let [positions, alphas, colours, scales, rotations, harmonics] = attributes;
    let Header { version, count, sh_degree, fractional_bits, .. } = *header;
    let step_m = 1.0 / (1u32 << fractional_bits) as f32;
    // Value of each byte, for each attribute.
    let table = |value: &dyn Fn(f32) -> f32| -> Vec<f32> {
        (0..=255u8).map(|byte| value(f32::from(byte))).collect()
    };
    let scale_m = table(&|byte| (byte / 16.0 - 10.0).exp());
    let colour = table(&|byte| (byte / 255.0 - 0.5) / COLOUR_SCALE);
    let harmonic = table(&|byte| (byte - 128.0) / 128.0);
    let per_splat = ((usize::from(sh_degree) + 1).pow(2) - 1) * 3;

    decode_all(sh_degree.min(3), count, meter, |first, block| {
        for i in 0..block.len() {
            let row = first + i;
            let position = |axis: usize| {
                if version == 1 {
                    f16::from_bits(u16_at(positions, row * 6 + axis * 2)).to_f32()
                } else {
                    let at = row * 9 + axis * 3;
                    // The third byte is the highest; the arithmetic shift extends its sign.
                    let word = [0, positions[at], positions[at + 1], positions[at + 2]];
                    (i32::from_le_bytes(word) >> 8) as f32 * step_m
                }
            };
            let rotation = if version < 3 {
                first_three(&rotations[row * 3..row * 3 + 3])
            } else {
                smallest_three(u32_at(rotations, row * 4))
            };
            let scale = |axis: usize| scale_m[usize::from(scales[row * 3 + axis])];
            let gaussian = Gaussian {
                mean_m: Vec3::new(position(0), -position(1), -position(2)),
                scale_m: Vec3::new(scale(0), scale(1), scale(2)),
                rotation_xyzw: [rotation[0], -rotation[1], -rotation[2], rotation[3]],
                opacity: f32::from(alphas[row]) / 255.0,
            };
            block.put(i, &gaussian, |k, channel| {
                if k == 0 {
                    colour[usize::from(colours[row * 3 + channel])]
                } else {
                    let at = row * per_splat + (k - 1) * 3 + channel;
                    harmonic[usize::from(harmonics[at])] * HARMONIC_SIGNS[k]
                }
            });
        }
    })
}

/// Returns the quaternion xyzw of versions 1 and 2.
fn first_three(bytes: &[u8]) -> [f32; 4] {
    let [x, y, z] = [0, 1, 2].map(|i| f32::from(bytes[i]) / 127.5 - 1.0);
    [x, y, z, (1.0 - x * x - y * y - z * z).max(0.0).sqrt()]
}

/// Returns the quaternion xyzw of version 3 and later.
#[inline]
fn smallest_three(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut xyzw = [0.0; 4];
    let mut squares = 0.0;
    let mut rest = word;
    // The last component is in the lowest bits.
    for i in (0..4).rev().filter(|&i| i != largest) {
        let size = (rest & 511) as f32 / 511.0 / SQRT_2;
        xyzw[i] = if rest & 512 == 0 { size } else { -size };
        squares += size * size;
        rest >>= 10;
    }
    xyzw[largest] = (1.0 - squares).max(0.0).sqrt();
    xyzw
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_1_SQRT_2;

    use super::smallest_three;

    #[test]
    fn decodes_a_rotation_as_specified() {
        // The largest component is w (3): x = +511, y = -256, z = 0 of 511.
        let word = 3 << 30 | 511 << 20 | (512 | 256) << 10;
        let [x, y, z, w] = smallest_three(word);
        assert!(
            (x - FRAC_1_SQRT_2).abs() < 1e-6 && (y + 256.0 / 511.0 * FRAC_1_SQRT_2).abs() < 1e-6
        );
        assert!(z == 0.0 && (x * x + y * y + w * w - 1.0).abs() < 1e-6);
    }
}
