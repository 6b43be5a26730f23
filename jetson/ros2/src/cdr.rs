//! Common Data Representation (OMG, "CDR", version 1): the wire format of ROS 2 messages.
//!
//! Every number is aligned to its size, counted from the first byte after the encapsulation header, which the DDS
//! library writes and reads. Strings have their length and a terminating NUL; sequences have their count. The writer is
//! little-endian; the reader accepts both byte orders. Not based on `serde`, so that an image of 1 MB is copied at once
//! and not byte by byte.

use thiserror::Error;

/// Writes a message, little-endian.
#[derive(Debug, Default)]
pub struct Writer {
    bytes: Vec<u8>,
}

/// Reads a message of either byte order. Never reads beyond its bytes, and never allocates more than they can hold.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    little: bool,
}

/// Why bytes do not decode.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum CdrError {
    /// The bytes end within a field.
    #[error("the message ends at byte {0}, within a field")]
    Short(usize),
    /// A string is not UTF-8 with a terminating NUL.
    #[error("the string at byte {0} is not UTF-8 with a NUL at its end")]
    Text(usize),
    /// The count of a sequence exceeds the limit.
    #[error("the sequence at byte {0} claims {1} elements")]
    Long(usize, u32),
}

impl Writer {
    /// Creates a writer with this capacity.
    pub fn with_capacity(bytes: usize) -> Self {
        Self { bytes: Vec::with_capacity(bytes) }
    }

    /// Returns the message.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    fn align(&mut self, to: usize) {
        self.bytes.resize(self.bytes.len().next_multiple_of(to), 0);
    }

    /// Writes a byte. A `bool` is 0 or 1.
    pub fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    /// Writes an unsigned number of 32 bits.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// Writes a signed number of 32 bits.
    pub fn i32(&mut self, value: i32) {
        self.u32(value as u32);
    }

    /// Writes a double.
    pub fn f64(&mut self, value: f64) {
        self.align(8);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// Writes an array of doubles, without its length.
    pub fn f64s(&mut self, values: &[f64]) {
        for &value in values {
            self.f64(value);
        }
    }

    /// Writes a string.
    pub fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend_from_slice(text.as_bytes());
        self.bytes.push(0);
    }

    /// Writes a sequence of bytes.
    pub fn blob(&mut self, bytes: &[u8]) {
        self.u32(bytes.len() as u32);
        self.bytes.extend_from_slice(bytes);
    }
}

impl<'a> Reader<'a> {
    /// Reads `bytes`, which follow the encapsulation header.
    pub fn new(bytes: &'a [u8], little: bool) -> Self {
        Self { bytes, at: 0, little }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let begin = self.at.next_multiple_of(N);
        let taken = self.bytes.get(begin..begin + N).ok_or(CdrError::Short(self.at))?;
        self.at = begin + N;
        let mut found = [0; N];
        found.copy_from_slice(taken);
        if !self.little {
            found.reverse();
        }
        Ok(found)
    }

    /// Reads a byte.
    pub fn u8(&mut self) -> Result<u8, CdrError> {
        self.take().map(u8::from_le_bytes)
    }

    /// Reads an unsigned number of 32 bits.
    pub fn u32(&mut self) -> Result<u32, CdrError> {
        self.take().map(u32::from_le_bytes)
    }

    /// Reads a signed number of 32 bits.
    pub fn i32(&mut self) -> Result<i32, CdrError> {
        self.take().map(i32::from_le_bytes)
    }

    /// Reads a double.
    pub fn f64(&mut self) -> Result<f64, CdrError> {
        self.take().map(f64::from_le_bytes)
    }

    /// Reads an array of doubles.
    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], CdrError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// Reads a string. A string of length 0, which the standard forbids but some senders write, is empty.
    pub fn text(&mut self) -> Result<&'a str, CdrError> {
        let len = self.u32()? as usize;
        let begin = self.at;
        let bytes = self.bytes[begin..].get(..len).ok_or(CdrError::Short(begin))?;
        self.at += len;
        let Some((&last, text)) = bytes.split_last() else { return Ok("") };
        match std::str::from_utf8(text) {
            Ok(text) if last == 0 => Ok(text),
            _ => Err(CdrError::Text(begin)),
        }
    }

    /// Reads the count of a sequence of at most `most` elements.
    pub fn count(&mut self, most: u32) -> Result<u32, CdrError> {
        let begin = self.at;
        let count = self.u32()?;
        if count > most { Err(CdrError::Long(begin, count)) } else { Ok(count) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligns_numbers_and_ends_strings_with_nul() {
        let mut writer = Writer::default();
        writer.u8(1);
        writer.u32(2);
        writer.text("abc");
        writer.f64(1.0);
        writer.blob(&[7]);
        let expected = [
            &[1, 0, 0, 0, 2, 0, 0, 0, 4, 0, 0, 0, b'a', b'b', b'c', 0][..],
            &1.0f64.to_le_bytes(),
            &[1, 0, 0, 0, 7],
        ];
        assert_eq!(writer.into_bytes(), expected.concat());
    }

    #[test]
    fn reads_big_endian_messages() {
        let bytes = [&[0, 0, 0, 3, b'h', b'i', 0, 0][..], &2.5f64.to_be_bytes()].concat();
        let mut reader = Reader::new(&bytes, false);
        assert_eq!((reader.text(), reader.f64()), (Ok("hi"), Ok(2.5)));
        assert_eq!(reader.u8(), Err(CdrError::Short(16)));
    }

    #[test]
    fn rejects_invalid_strings_and_long_sequences() {
        for (bytes, expected) in [
            (&[2, 0, 0, 0, b'a', b'b'][..], CdrError::Text(4)),
            (&[2, 0, 0, 0, 0xff, 0], CdrError::Text(4)),
            (&[255, 255, 255, 255, 0], CdrError::Short(4)),
        ] {
            assert_eq!(Reader::new(bytes, true).text(), Err(expected));
        }
        assert_eq!(Reader::new(&[9, 0, 0, 0], true).count(8), Err(CdrError::Long(0, 9)));
    }
}
