//! Reads the fields of a message by byte offset.

/// Fields of a payload. Bytes that MAVLink 2 truncated read as zero.
pub(super) struct Fields<'a>(pub &'a [u8]);

impl<'a> Fields<'a> {
    pub(super) fn bytes<const N: usize>(&self, at: usize) -> [u8; N] {
        core::array::from_fn(|i| self.byte(at + i))
    }

    pub(super) fn byte(&self, at: usize) -> u8 {
        self.0.get(at).copied().unwrap_or(0)
    }

    pub(super) fn u16(&self, at: usize) -> u16 {
        u16::from_le_bytes(self.bytes(at))
    }

    pub(super) fn u32(&self, at: usize) -> u32 {
        u32::from_le_bytes(self.bytes(at))
    }

    pub(super) fn i64(&self, at: usize) -> i64 {
        i64::from_le_bytes(self.bytes(at))
    }

    pub(super) fn f32(&self, at: usize) -> f32 {
        f32::from_le_bytes(self.bytes(at))
    }

    /// Returns a name of at most 16 characters; empty if it is not UTF-8.
    pub(super) fn text(&self, at: usize) -> &'a str {
        let field = self.0.get(at..).unwrap_or_default();
        let field = &field[..field.len().min(16)];
        let end = field.iter().position(|&byte| byte == 0).unwrap_or(field.len());
        core::str::from_utf8(&field[..end]).unwrap_or_default()
    }
}
