//! Bit streams, low bits first.

/// Writes numbers of up to 32 bits.
#[derive(Clone, Debug, Default)]
pub(crate) struct BitWriter {
    /// Written bytes, then reserved space.
    bytes: Vec<u8>,
    len: usize,
    open: u64,
    /// Number of bits in `open`, 0 to 31 between calls.
    used: u32,
}

impl BitWriter {
    /// Clears the writer and reserves space for at most `most_bits` bits.
    pub(crate) fn start(&mut self, most_bits: usize) {
        // Eight extra bytes, so that a whole word can be written at any position.
        let room = most_bits.div_ceil(8) + 8;
        if self.bytes.len() < room {
            self.bytes.resize(room, 0);
        }
        (self.len, self.open, self.used) = (0, 0, 0);
    }

    /// Appends the `count` low bits of `value`, 0 to 32; the others must be 0.
    #[inline(always)]
    pub(crate) fn push(&mut self, value: u32, count: u32) {
        debug_assert!(count <= 32 && (count == 32 || value >> count == 0));
        self.open |= u64::from(value) << self.used;
        self.used += count;
        if self.used >= 32 {
            self.bytes[self.len..self.len + 4].copy_from_slice(&(self.open as u32).to_le_bytes());
            self.len += 4;
            self.open >>= 32;
            self.used -= 32;
        }
    }

    /// Appends all bits to `out`, padded to a whole byte.
    pub(crate) fn finish(&mut self, out: &mut Vec<u8>) {
        out.extend_from_slice(&self.bytes[..self.len]);
        out.extend_from_slice(&self.open.to_le_bytes()[..self.used.div_ceil(8) as usize]);
    }
}

/// Reads the output of [`BitWriter`]; returns zeros beyond its end.
#[derive(Clone, Debug)]
pub(crate) struct BitReader<'a> {
    bytes: &'a [u8],
    at_bit: usize,
}

impl<'a> BitReader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at_bit: 0 }
    }

    /// Reads `count` bits, 0 to 32.
    #[inline(always)]
    pub(crate) fn pop(&mut self, count: u32) -> u32 {
        let from = self.at_bit / 8;
        let word = match self.bytes.get(from..from + 8) {
            Some(word) => u64::from_le_bytes(word.try_into().unwrap_or_default()),
            None => self.last_word(from),
        };
        let value = word >> (self.at_bit % 8) & ((1 << count) - 1);
        self.at_bit += count as usize;
        value as u32
    }

    #[cold]
    fn last_word(&self, from: usize) -> u64 {
        let mut word = [0; 8];
        let left = self.bytes.get(from..).unwrap_or(&[]);
        word[..left.len()].copy_from_slice(left);
        u64::from_le_bytes(word)
    }

    /// Returns whether exactly all bytes have been read.
    pub(crate) fn is_finished(&self) -> bool {
        self.at_bit.div_ceil(8) == self.bytes.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn numbers_survive_a_round_trip(numbers in prop::collection::vec((any::<u32>(), 0u32..=32), 0..200)) {
            let numbers: Vec<(u32, u32)> = numbers
                .into_iter()
                .map(|(value, count)| (value & ((1u64 << count) - 1) as u32, count))
                .collect();
            let mut writer = BitWriter::default();
            writer.start(numbers.iter().map(|number| number.1 as usize).sum());
            for &(value, count) in &numbers {
                writer.push(value, count);
            }
            let mut bytes = Vec::new();
            writer.finish(&mut bytes);
            let mut reader = BitReader::new(&bytes);
            for &(value, count) in &numbers {
                prop_assert_eq!(reader.pop(count), value);
            }
            prop_assert!(reader.is_finished());
            reader.pop(32);
            prop_assert_eq!(reader.pop(7), 0);
        }
    }
}
