//! Columns of numbers: glTF accessors.

use super::container::Bytes;
use super::scene::Root;
use super::{invalid, unsupported};
use crate::format::FormatError;
use crate::format::bytes::{f32_at, u16_at, u32_at};

/// Numbers at a constant stride in a buffer. The last of them was checked to lie within it.
pub(super) struct Column<'a> {
    /// Bytes from the first number to the end of the buffer view.
    bytes: &'a [u8],
    stride: usize,
    component: Component,
    normalized: bool,
    /// Number of rows.
    pub(super) count: usize,
}

#[derive(Clone, Copy)]
enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(component_type: u32) -> Option<Self> {
        Some(match component_type {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }
}

impl<'a> Column<'a> {
    /// Returns the column of accessor `index`. Checks its type and that all of it is in the buffer.
    pub(super) fn find(
        root: &Root,
        buffers: &'a [Bytes<'_>],
        index: usize,
        kind: &str,
    ) -> Result<Self, FormatError> {
        let place = || format!("accessor {index}");
        let missing = |what: &str| invalid(place(), format!("no such {what}"));
        let accessor = root.accessors.get(index).ok_or_else(|| missing("accessor"))?;
        if accessor.sparse.is_some() {
            return Err(unsupported("a sparse accessor", "save it without"));
        }
        if accessor.kind != kind {
            return Err(invalid(place(), format!("type {} instead of {kind}", accessor.kind)));
        }
        let component =
            Component::of(accessor.component_type).ok_or_else(|| missing("component type"))?;
        let Some(view) = accessor.buffer_view else {
            return Err(invalid(place(), "without a bufferView: zeros, or packed by an extension"));
        };
        let view = root.buffer_views.get(view).ok_or_else(|| missing("bufferView"))?;
        let buffer = buffers.get(view.buffer).ok_or_else(|| missing("buffer"))?.get();
        let width = match kind {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        let row = (width * component.bytes()) as u64;
        let stride = view.byte_stride.unwrap_or(row);
        if stride < row {
            return Err(invalid(place(), format!("rows of {row} bytes every {stride} bytes")));
        }
        // Saturating: a value that overflows exceeds any buffer.
        let needed = match accessor.count {
            0 => 0,
            count => stride.saturating_mul(count - 1).saturating_add(row),
        };
        let start = view.byte_offset.saturating_add(accessor.byte_offset);
        let within = accessor.byte_offset.saturating_add(needed) <= view.byte_length
            && view.byte_offset.saturating_add(view.byte_length) <= buffer.len() as u64;
        if !within {
            let length = buffer.len();
            let reason = format!("{needed} bytes from byte {start} on, in a buffer of {length}");
            return Err(invalid(place(), reason));
        }
        Ok(Self {
            bytes: &buffer[start as usize..],
            stride: stride as usize,
            component,
            normalized: accessor.normalized,
            count: accessor.count as usize,
        })
    }

    /// Returns number `k` of a row.
    #[inline]
    pub(super) fn at(&self, row: usize, k: usize) -> f32 {
        let at = row * self.stride + k * self.component.bytes();
        let share = |value: f32, most: f32| {
            if self.normalized { (value / most).max(-1.0) } else { value }
        };
        match self.component {
            Component::F32 => f32_at(self.bytes, at),
            Component::U8 => share(f32::from(self.bytes[at]), 255.0),
            Component::I8 => share(f32::from(self.bytes[at] as i8), 127.0),
            Component::U16 => share(f32::from(u16_at(self.bytes, at)), 65535.0),
            Component::I16 => share(f32::from(u16_at(self.bytes, at) as i16), 32767.0),
            Component::U32 => share(u32_at(self.bytes, at) as f32, u32::MAX as f32),
        }
    }
}
