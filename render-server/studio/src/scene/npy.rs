//! Writes arrays for `numpy.load`: .npy format, version 1.0, little-endian, C order
//! (numpy.org/doc/stable/reference/generated/numpy.lib.format.html).

use std::io::{self, Write};
use std::path::Path;

use anyhow::{Context, Result};

/// Element type of an array.
pub(crate) trait Element: Copy {
    /// Type string of numpy: byte order, kind, bytes.
    const DESCRIPTION: &'static str;

    /// Writes the value in little-endian order.
    fn write(self, out: &mut impl Write) -> io::Result<()>;
}

impl Element for f32 {
    const DESCRIPTION: &'static str = "<f4";

    fn write(self, out: &mut impl Write) -> io::Result<()> {
        out.write_all(&self.to_le_bytes())
    }
}

impl Element for u16 {
    const DESCRIPTION: &'static str = "<u2";

    fn write(self, out: &mut impl Write) -> io::Result<()> {
        out.write_all(&self.to_le_bytes())
    }
}

/// Writes `values` (row-major) as an array of this shape to a file.
pub(crate) fn save<T: Element>(path: &Path, shape: &[usize], values: &[T]) -> Result<()> {
    let write = || {
        let mut out = io::BufWriter::new(std::fs::File::create(path)?);
        write(&mut out, shape, values)?;
        out.flush()
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

/// # Panics
/// The number of values does not match the shape.
fn write<T: Element>(out: &mut impl Write, shape: &[usize], values: &[T]) -> io::Result<()> {
    assert_eq!(shape.iter().product::<usize>(), values.len(), "one value per place");
    // Tuple in Python's notation: (4,) or (2, 3).
    let sides: Vec<String> = shape.iter().map(ToString::to_string).collect();
    let comma = if shape.len() == 1 { "," } else { "" };
    let sides = sides.join(", ") + comma;
    let description = T::DESCRIPTION;
    let mut head =
        format!("{{'descr': '{description}', 'fortran_order': False, 'shape': ({sides}), }}");
    // The header is padded so that the values begin at a multiple of 64 bytes. It ends with a line feed.
    let length = (MAGIC.len() + 2 + head.len() + 1).next_multiple_of(64) - MAGIC.len() - 2;
    head.extend(std::iter::repeat_n(' ', length - 1 - head.len()));
    head.push('\n');
    out.write_all(MAGIC)?;
    out.write_all(&(length as u16).to_le_bytes())?;
    out.write_all(head.as_bytes())?;
    values.iter().try_for_each(|value| value.write(out))
}

/// Magic and version 1.0.
const MAGIC: &[u8; 8] = b"\x93NUMPY\x01\x00";

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes<T: Element>(shape: &[usize], values: &[T]) -> Vec<u8> {
        let mut out = Vec::new();
        write(&mut out, shape, values).unwrap();
        out
    }

    /// Expected: output of numpy 2.3 for `np.save(f, np.array([[1, 2, 3], [4, 5, 6]], '<u2'))`.
    #[test]
    fn writes_the_same_bytes_as_numpy() {
        let found = bytes(&[2, 3], &[1u16, 2, 3, 4, 5, 6]);
        let head = "{'descr': '<u2', 'fortran_order': False, 'shape': (2, 3), }";
        let mut expected = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        expected.extend_from_slice(head.as_bytes());
        expected.resize(127, b' ');
        expected.push(b'\n');
        expected.extend_from_slice(&[1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0]);
        assert_eq!(found, expected);
    }

    #[test]
    fn writes_shapes_as_tuples_and_aligns_values() {
        for (shape, text) in
            [(vec![4], "(4,)"), (vec![2, 2], "(2, 2)"), (vec![1, 2, 2], "(1, 2, 2)")]
        {
            let found = bytes(&shape, &[0.5f32, -1.0, f32::NAN, f32::INFINITY]);
            let head = usize::from(u16::from_le_bytes([found[8], found[9]]));
            assert!((10 + head).is_multiple_of(64));
            assert!(String::from_utf8_lossy(&found[10..10 + head]).contains(text));
            assert_eq!(found[10 + head..][..4], 0.5f32.to_le_bytes());
            assert_eq!(found.len(), 10 + head + 16);
        }
    }
}
