//! Object ids as runs of one id, or of copies from the row above.
//!
//! A run is a number, `(length - 1) << 1 | copies`. If `copies` is 0, the id follows. Both are encoded in groups of
//! seven bits, low ones first; the eighth bit is set if more groups follow (LEB128). Copies continue over the ends of
//! rows, so several unchanged rows are one run.

use crate::error::DecodeError;

/// Appends the encoding of a row-major plane of ids to `out`.
pub(crate) fn encode(ids: &[u16], width: usize, out: &mut Vec<u8>) {
    let mut at = 0;
    while at < ids.len() {
        let rest = &ids[at..];
        let same = rest.iter().take_while(|&&id| id == rest[0]).count();
        let copied = match at.checked_sub(width) {
            Some(above) => rest.iter().zip(&ids[above..]).take_while(|(id, up)| id == up).count(),
            None => 0,
        };
        let length = same.max(copied);
        push_number(out, (length as u32 - 1) << 1 | u32::from(copied >= same));
        if copied < same {
            push_number(out, u32::from(rest[0]));
        }
        at += length;
    }
}

/// Decodes to a row-major plane.
///
/// # Errors
/// [`DecodeError::Ids`] unless the runs end exactly at the end of the plane and of the bytes.
pub(crate) fn decode(mut bytes: &[u8], width: usize, ids: &mut [u16]) -> Result<(), DecodeError> {
    let mut at = 0;
    while at < ids.len() {
        let run = pop_number(&mut bytes).ok_or(DecodeError::Ids)?;
        let length = (run >> 1) as usize + 1;
        if length > ids.len() - at {
            return Err(DecodeError::Ids);
        }
        if run & 1 == 1 {
            let above = at.checked_sub(width).ok_or(DecodeError::Ids)?;
            // A run that is longer than a row also copies its own output: row by row.
            let (mut from, mut left) = (above, length);
            while left > 0 {
                let count = left.min(width);
                ids.copy_within(from..from + count, from + width);
                from += count;
                left -= count;
            }
        } else {
            let id = pop_number(&mut bytes).ok_or(DecodeError::Ids)?;
            let id = u16::try_from(id).map_err(|_| DecodeError::Ids)?;
            ids[at..at + length].fill(id);
        }
        at += length;
    }
    if bytes.is_empty() { Ok(()) } else { Err(DecodeError::Ids) }
}

fn push_number(out: &mut Vec<u8>, mut number: u32) {
    while number >= 0x80 {
        out.push(number as u8 | 0x80);
        number >>= 7;
    }
    out.push(number as u8);
}

/// Reads a number of at most 32 bits.
fn pop_number(bytes: &mut &[u8]) -> Option<u32> {
    let mut number = 0u64;
    for shift in [0, 7, 14, 21, 28] {
        let (&byte, rest) = bytes.split_first()?;
        *bytes = rest;
        number |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return u32::try_from(number).ok();
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[track_caller]
    fn check_round_trip(ids: &[u16], width: usize) -> usize {
        let mut bytes = Vec::new();
        encode(ids, width, &mut bytes);
        let mut out = vec![9; ids.len()];
        decode(&bytes, width, &mut out).unwrap();
        assert_eq!(out, ids);
        bytes.len()
    }

    #[test]
    fn compresses_uniform_planes_and_single_objects() {
        assert!(check_round_trip(&vec![0; 640 * 480], 640) < 8);
        let mut ids = vec![0; 640 * 480];
        for y in 100..200 {
            ids[y * 640 + 300..y * 640 + 350].fill(7);
        }
        // The first row of the object has three runs; the rest is copied.
        assert!(check_round_trip(&ids, 640) < 20);
    }

    #[test]
    fn rejects_damaged_bytes() {
        let mut out = [0; 12];
        for bytes in [&[][..], &[0], &[1], &[22], &[24, 0], &[22, 0, 0], &[22, 255, 255, 255, 0]] {
            assert_eq!(decode(bytes, 4, &mut out), Err(DecodeError::Ids), "{bytes:?}");
        }
        assert_eq!(decode(&[22, 5], 4, &mut out), Ok(()));
        assert_eq!(out, [5; 12]);
    }

    proptest! {
        #[test]
        fn ids_survive_a_round_trip(width in 1usize..40, height in 1usize..40, seed: u32, few in 1u32..5) {
            let ids: Vec<u16> = (0..(width * height) as u32)
                .map(|n| (n.wrapping_mul(seed) >> 27).wrapping_mul(60_000 / few) as u16)
                .collect();
            check_round_trip(&ids, width);
        }

        #[test]
        fn does_not_panic_on_arbitrary_bytes(bytes in prop::collection::vec(any::<u8>(), 0..60), width in 1usize..9) {
            let mut out = vec![0; width * 7];
            let _ = decode(&bytes, width, &mut out);
        }
    }
}
