//! Decoder of rows of numbers, binary or ascii.
//!
//! The length of the file is checked before memory is allocated.

use glam::Vec3;

use super::header::{Element, Header, PropertyKind, Scalar, VERTEX};
use super::layout::{Layout, slot};
use super::{DropCounts, PlyError};
use crate::Splats;
use crate::format::activate::{exp, harmonic_of_colour, sigmoid};
use crate::format::block::{Block, Builder, Gaussian, SPLATS_PER_TASK, decode_all};
use crate::format::progress::Meter;

/// Decodes the vertex element of a binary little-endian file.
pub(super) fn read_binary(
    bytes: &[u8],
    header: &Header,
    layout: &Layout,
    meter: &Meter,
) -> Result<(Splats, DropCounts), PlyError> {
    let mut offset = header.body;
    for element in header.elements.iter().take_while(|element| element.name != VERTEX) {
        offset = match element.fixed_row_bytes() {
            Some(row) => offset + fixed_length(bytes, offset, element, row)?,
            None => variable_rows(bytes, offset, element, |_, _| {})?,
        };
    }
    let vertex = header.vertex();
    // Offset of each column in a row, if there are no lists.
    if let Some(row_bytes) = vertex.fixed_row_bytes() {
        let length = fixed_length(bytes, offset, vertex, row_bytes)?;
        let mut starts = Vec::with_capacity(vertex.properties.len());
        let mut start = 0;
        for property in &vertex.properties {
            starts.push(start);
            if let PropertyKind::Scalar(scalar) = property.kind {
                start += scalar.bytes();
            }
        }
        let slots: Vec<(usize, Scalar)> =
            layout.slots.iter().map(|slot| (starts[slot.column], slot.scalar)).collect();
        let data = &bytes[offset..offset + length];
        return Ok(decode_all(layout.sh_degree, vertex.count, meter, |first, block| {
            let rows = data[first * row_bytes..].chunks_exact(row_bytes).take(block.len());
            for (i, row) in rows.enumerate() {
                // Nearly all files contain only f32: one well-predicted branch per number.
                put(block, layout, i, |slot| match slots[slot] {
                    (at, Scalar::F32) => {
                        f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]])
                    }
                    (at, scalar) => scalar.read(&row[at..]) as f32,
                });
            }
        }));
    }
    // Some columns are lists: walk once, row by row, for the offsets of all numbers.
    minimum_length(bytes, offset, vertex)?;
    let columns = vertex.properties.len();
    let mut starts: Vec<usize> = Vec::with_capacity(vertex.count.saturating_mul(columns));
    variable_rows(bytes, offset, vertex, |_, at| starts.push(at))?;
    Ok(decode_all(layout.sh_degree, vertex.count, meter, |first, block| {
        for i in 0..block.len() {
            let row = &starts[(first + i) * columns..][..columns];
            put(block, layout, i, |slot| {
                let slot = layout.slots[slot];
                slot.scalar.read(&bytes[row[slot.column]..]) as f32
            });
        }
    }))
}

/// Decodes the vertex element of an ascii file. Rows are separated by counting numbers; line ends
/// have no meaning.
pub(super) fn read_ascii(
    bytes: &[u8],
    header: &Header,
    layout: &Layout,
    meter: &Meter,
) -> Result<(Splats, DropCounts), PlyError> {
    let mut tokens = Tokens { bytes, offset: header.body };
    for element in header.elements.iter().take_while(|element| element.name != VERTEX) {
        if element.properties.is_empty() {
            continue;
        }
        for row in 0..element.count {
            for property in &element.properties {
                tokens.skip(element, row, property.kind)?;
            }
        }
    }
    let vertex = header.vertex();
    // Each number takes a digit and a separator, except for the last separator.
    let needed = vertex.count as u128 * vertex.properties.len() as u128 * 2;
    let available = bytes.len() - tokens.offset;
    if needed > available as u128 + 1 {
        return Err(truncated(vertex, tokens.offset, needed, available));
    }
    let mut slot_of_column = vec![usize::MAX; vertex.properties.len()];
    for (i, slot) in layout.slots.iter().enumerate() {
        slot_of_column[slot.column] = i;
    }
    let mut builder = Builder::new(layout.sh_degree, vertex.count);
    let mut values = vec![0f32; layout.slots.len()];
    let mut dropped = DropCounts::default();
    for (first, block) in builder.blocks(SPLATS_PER_TASK).enumerate() {
        let mut block = block;
        for i in 0..block.len() {
            let row = first * SPLATS_PER_TASK + i;
            for (property, &slot) in vertex.properties.iter().zip(&slot_of_column) {
                match property.kind {
                    PropertyKind::Scalar(_) if slot != usize::MAX => {
                        values[slot] = tokens.number(vertex, row, &property.name)? as f32;
                    }
                    kind => tokens.skip(vertex, row, kind)?,
                }
            }
            put(&mut block, layout, i, |slot| values[slot]);
        }
        meter.add(block.len());
        dropped = dropped.plus(block.dropped());
    }
    Ok((builder.finish(dropped), dropped))
}

/// Stores row `i`, given its raw numbers `raw(slot)`.
#[inline]
fn put(block: &mut Block, layout: &Layout, i: usize, raw: impl Fn(usize) -> f32) {
    let three = |first: usize| Vec3::new(raw(first), raw(first + 1), raw(first + 2));
    let wxyz = [0, 1, 2, 3].map(|k| raw(slot::ROTATION_WXYZ + k));
    let gaussian = Gaussian {
        mean_m: three(slot::MEAN),
        scale_m: exp(three(slot::LOG_SCALE)),
        rotation_xyzw: [wxyz[1], wxyz[2], wxyz[3], wxyz[0]],
        opacity: sigmoid(raw(slot::OPACITY_LOGIT)),
    };
    block.put(i, &gaussian, |k, channel| match k {
        0 if layout.colour_bytes => harmonic_of_colour(raw(slot::SH_DC + channel) / 255.0),
        0 => raw(slot::SH_DC + channel),
        // Channel-major in the file, coefficient-major in memory.
        _ => raw(slot::SH_REST + channel * layout.rest_per_channel + k - 1),
    });
}

/// Returns the bytes of an element with fixed rows, after checking that they are complete.
pub(super) fn fixed_length(
    bytes: &[u8],
    offset: usize,
    element: &Element,
    row: usize,
) -> Result<usize, PlyError> {
    let needed = element.count as u128 * row as u128;
    let available = bytes.len() - offset;
    if needed > available as u128 {
        return Err(truncated(element, offset, needed, available));
    }
    Ok(needed as usize)
}

fn minimum_length(bytes: &[u8], offset: usize, element: &Element) -> Result<(), PlyError> {
    fixed_length(bytes, offset, element, element.min_row_bytes()).map(|_| ())
}

/// Walks the rows of an element with lists. Calls `visit` with (column, byte) of every property,
/// and returns the end of the element. Every row takes at least one byte, so the size of the file
/// bounds the time.
fn variable_rows(
    bytes: &[u8],
    start: usize,
    element: &Element,
    mut visit: impl FnMut(usize, usize),
) -> Result<usize, PlyError> {
    minimum_length(bytes, start, element)?;
    let mut offset = start;
    for row in 0..element.count {
        for (column, property) in element.properties.iter().enumerate() {
            visit(column, offset);
            let (head, item) = match property.kind {
                PropertyKind::Scalar(scalar) => (scalar.bytes(), None),
                PropertyKind::List { count, item } => (count.bytes(), Some((count, item))),
            };
            let available = bytes.len() - offset;
            if head > available {
                return Err(truncated(element, offset, head as u128, available));
            }
            let mut length = head as u128;
            if let Some((count, item)) = item {
                let items = count.read(&bytes[offset..]);
                if !(items >= 0.0 && items.fract() == 0.0) {
                    return Err(PlyError::Value {
                        offset,
                        element: element.name.clone(),
                        row,
                        reason: format!("list `{}` has length {items}", property.name),
                    });
                }
                // `as` saturates, so a huge float cannot overflow.
                length += u128::from(items as u64) * item.bytes() as u128;
            }
            if length > available as u128 {
                return Err(truncated(element, offset, length, available));
            }
            offset += length as usize;
        }
    }
    Ok(offset)
}

pub(super) fn truncated(
    element: &Element,
    offset: usize,
    needed: u128,
    available: usize,
) -> PlyError {
    PlyError::Truncated {
        element: element.name.clone(),
        declared: element.count,
        offset,
        needed,
        available,
    }
}

/// Whitespace-separated numbers of an ascii body.
struct Tokens<'a> {
    bytes: &'a [u8],
    offset: usize,
}

impl Tokens<'_> {
    /// Returns the next number.
    fn number(&mut self, element: &Element, row: usize, property: &str) -> Result<f64, PlyError> {
        let rest = &self.bytes[self.offset..];
        let blank = rest.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
        let length = rest[blank..].iter().take_while(|byte| !byte.is_ascii_whitespace()).count();
        let offset = self.offset + blank;
        let fail =
            |reason| Err(PlyError::Value { offset, element: element.name.clone(), row, reason });
        let word = &rest[blank..blank + length];
        if word.is_empty() {
            return fail(format!("the file ends before `{property}`"));
        }
        self.offset = offset + length;
        // Truncate the text in the error, because the word can be as long as the file.
        match str::from_utf8(word).ok().and_then(|word| word.parse().ok()) {
            Some(number) => Ok(number),
            None => fail(format!(
                "`{property}` is {:?}, not a number",
                String::from_utf8_lossy(&word[..word.len().min(32)])
            )),
        }
    }

    /// Skips one property.
    fn skip(&mut self, element: &Element, row: usize, kind: PropertyKind) -> Result<(), PlyError> {
        let offset = self.offset;
        let first = self.number(element, row, "a skipped property")?;
        if let PropertyKind::List { .. } = kind {
            if !(first >= 0.0 && first.fract() == 0.0) {
                return Err(PlyError::Value {
                    offset,
                    element: element.name.clone(),
                    row,
                    reason: format!("a list has length {first}"),
                });
            }
            for _ in 0..first as u64 {
                self.number(element, row, "a list's item")?;
            }
        }
        Ok(())
    }
}
