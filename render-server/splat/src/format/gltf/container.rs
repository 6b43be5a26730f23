//! Container of a glTF file: its JSON and the bytes of its buffers.

use std::borrow::Cow;
use std::path::Path;

use memmap2::Mmap;

use super::scene::{Buffer, Root};
use super::{invalid, unsupported};
use crate::format::bytes::u32_at;
use crate::format::{Format, FormatError, file};

/// The first bytes of a `.glb`.
pub(in crate::format) const MAGIC: &[u8] = b"glTF";
/// Chunk types.
const JSON: u32 = u32::from_le_bytes(*b"JSON");
const BIN: u32 = u32::from_le_bytes(*b"BIN\0");
/// Maximum number of buffers of a file; typical files have one.
const MAX_BUFFERS: usize = 1024;

/// Bytes of a buffer, in memory or mapped from a file.
pub(super) enum Bytes<'a> {
    Here(Cow<'a, [u8]>),
    Mapped(Mmap),
}

impl Bytes<'_> {
    pub(super) fn get(&self) -> &[u8] {
        match self {
            Self::Here(bytes) => bytes,
            Self::Mapped(bytes) => bytes,
        }
    }
}

/// Returns the JSON and the buffers of a file. `folder` is its location, if known.
pub(super) fn open<'a>(
    bytes: &'a [u8],
    folder: Option<&Path>,
) -> Result<(Root, Vec<Bytes<'a>>), FormatError> {
    let (json, binary) = if bytes.starts_with(MAGIC) { chunks(bytes)? } else { (bytes, None) };
    let root: Root =
        serde_json::from_slice(json).map_err(|error| invalid("JSON", error.to_string()))?;
    if root.buffers.len() > MAX_BUFFERS {
        return Err(invalid("buffers", format!("{} of them", root.buffers.len())));
    }
    let each = root.buffers.iter().enumerate().map(|(i, described)| {
        let place = || format!("buffer {i}");
        let bytes = match (&described.uri, binary) {
            (Some(uri), _) => fetch(uri, folder).map_err(|error| at(error, place()))?,
            (None, Some(binary)) if i == 0 => Bytes::Here(binary.into()),
            _ => return Err(invalid(place(), "neither a uri nor the binary chunk")),
        };
        check(described, bytes.get()).map(|()| bytes)
    });
    let buffers = each.collect::<Result<_, FormatError>>()?;
    Ok((root, buffers))
}

fn at(error: FormatError, place: String) -> FormatError {
    match error {
        FormatError::Invalid { format, reason, .. } => {
            FormatError::Invalid { format, place, reason }
        }
        other => other,
    }
}

fn check(described: &Buffer, bytes: &[u8]) -> Result<(), FormatError> {
    if described.byte_length > bytes.len() as u64 {
        return Err(FormatError::Truncated {
            format: Format::Gltf,
            what: "a buffer",
            needed: described.byte_length,
            available: bytes.len() as u64,
        });
    }
    Ok(())
}

/// Returns the JSON and the binary chunk of a `.glb`: a header of 12 bytes, then length, type and
/// content of each chunk.
fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), FormatError> {
    let truncated = |needed: u64| FormatError::Truncated {
        format: Format::Gltf,
        what: "a chunk",
        needed,
        available: bytes.len() as u64,
    };
    if bytes.len() < 20 {
        return Err(truncated(20));
    }
    let version = u32_at(bytes, 4);
    if version != 2 {
        return Err(unsupported(format!("version {version} of GLB"), "save it as glTF 2.0"));
    }
    let (mut json, mut binary, mut start) = (None, None, 12);
    while start + 8 <= bytes.len() {
        let (length, kind) = (u32_at(bytes, start) as usize, u32_at(bytes, start + 4));
        let end = (start + 8).saturating_add(length);
        let content = bytes.get(start + 8..end).ok_or_else(|| truncated(end as u64))?;
        match kind {
            JSON if json.is_none() => json = Some(content),
            BIN if binary.is_none() => binary = Some(content),
            _ => {}
        }
        start = end;
    }
    json.map(|json| (json, binary)).ok_or_else(|| invalid("GLB", "no JSON chunk"))
}

/// Returns the bytes of a URI: embedded data, or a file in the scene's folder.
fn fetch(uri: &str, folder: Option<&Path>) -> Result<Bytes<'static>, FormatError> {
    if let Some(data) = uri.strip_prefix("data:") {
        let text = data.split_once(";base64,").map(|(_, text)| text);
        let bytes = text.and_then(base64);
        return bytes
            .map(|bytes| Bytes::Here(bytes.into()))
            .ok_or_else(|| invalid("", "a data uri that is not base64"));
    }
    // A scene may only refer to files in its own folder.
    if uri.is_empty() || uri.contains(['/', '\\', ':', '%', '\0']) || uri == ".." {
        return Err(invalid("", format!("{uri:?} is not a plain file name; save it as .glb")));
    }
    let Some(folder) = folder else {
        return Err(unsupported("a buffer in another file", "save it as .glb"));
    };
    let path = folder.join(uri);
    let mapped = file::map(&path);
    mapped.map(Bytes::Mapped).map_err(|cause| FormatError::Io { path, verb: "read", cause })
}

/// Decodes base64 (RFC 4648, section 4), padded or not.
fn base64(text: &str) -> Option<Vec<u8>> {
    let text = text.trim_end_matches('=').as_bytes();
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3 + 2);
    for group in text.chunks(4) {
        let mut word = 0u32;
        for &symbol in group {
            let value = match symbol {
                b'A'..=b'Z' => symbol - b'A',
                b'a'..=b'z' => symbol - b'a' + 26,
                b'0'..=b'9' => symbol - b'0' + 52,
                b'+' => 62,
                b'/' => 63,
                _ => return None,
            };
            word = word << 6 | u32::from(value);
        }
        let full = word << (6 * (4 - group.len()));
        let length = match group.len() {
            4 => 3,
            3 => 2,
            2 => 1,
            _ => return None,
        };
        bytes.extend_from_slice(&full.to_be_bytes()[1..=length]);
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::base64;

    #[test]
    fn decodes_the_base64_examples_of_rfc_4648() {
        for (text, bytes) in [
            ("", ""),
            ("Zg==", "f"),
            ("Zm8=", "fo"),
            ("Zm9v", "foo"),
            ("Zm9vYg==", "foob"),
            ("Zm9vYmE", "fooba"),
        ] {
            assert_eq!(base64(text).as_deref(), Some(bytes.as_bytes()), "{text}");
        }
        assert!(base64("Z").is_none() && base64("Zm9$").is_none());
    }
}
