//! Reads float32 arrays from NumPy's `.npz`: a zip archive of `.npy` files
//! (PKWARE APPNOTE 4.3, NumPy format version 1).

use std::collections::HashMap;
use std::io::Read as _;
use std::path::Path;

use flate2::read::DeflateDecoder;

/// Returns the little-endian float32 arrays of an archive by name, flattened; skips other types.
pub(crate) fn read(path: &Path) -> HashMap<String, Vec<f32>> {
    let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let u16_at = |at: usize| usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
    let u32_at = |at: usize| u16_at(at) | u16_at(at + 2) << 16;
    let end = bytes.windows(4).rposition(|w| w == b"PK\x05\x06").expect("a zip archive");
    let mut at = u32_at(end + 16);
    let mut arrays = HashMap::new();
    for _ in 0..u16_at(end + 10) {
        assert_eq!(&bytes[at..at + 4], b"PK\x01\x02", "central directory");
        let (method, size) = (u16_at(at + 10), u32_at(at + 20));
        let (name_length, local) = (u16_at(at + 28), u32_at(at + 42));
        let name = String::from_utf8_lossy(&bytes[at + 46..at + 46 + name_length]);
        let data = local + 30 + u16_at(local + 26) + u16_at(local + 28);
        let packed = &bytes[data..data + size];
        let mut npy = Vec::new();
        match method {
            0 => npy.extend_from_slice(packed),
            8 => drop(DeflateDecoder::new(packed).read_to_end(&mut npy).expect("deflated data")),
            other => panic!("{name}: compression method {other}"),
        }
        let body = 10 + usize::from(u16::from_le_bytes([npy[8], npy[9]]));
        if String::from_utf8_lossy(&npy[..body]).contains("'<f4'") {
            let numbers = npy[body..].chunks_exact(4);
            let numbers = numbers.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            arrays.insert(name.trim_end_matches(".npy").to_owned(), numbers);
        }
        at += 46 + name_length + u16_at(at + 30) + u16_at(at + 32);
    }
    arrays
}
