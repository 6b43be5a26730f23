//! Header of a PLY file: format, elements, typed properties.

use super::PlyError;

/// Name of the element with one row per splat.
pub(super) const VERTEX: &str = "vertex";

/// Maximum size of a header; a header of splats has 2 kB. [byte]
const MAX_HEADER_BYTES: usize = 1 << 20;

/// Encoding of the rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    /// Packed little-endian numbers.
    BinaryLittleEndian,
    /// Decimal numbers between white space.
    Ascii,
}

/// Type of one number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Returns the size in a binary file. [byte]
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Reads one little-endian number from the start of `bytes`.
    ///
    /// # Panics
    /// If `bytes` is shorter than [`Self::bytes`]; callers have checked the row.
    #[inline]
    pub(super) fn read(self, bytes: &[u8]) -> f64 {
        let four = || [bytes[0], bytes[1], bytes[2], bytes[3]];
        match self {
            Self::I8 => f64::from(bytes[0] as i8),
            Self::U8 => f64::from(bytes[0]),
            Self::I16 => f64::from(i16::from_le_bytes([bytes[0], bytes[1]])),
            Self::U16 => f64::from(u16::from_le_bytes([bytes[0], bytes[1]])),
            Self::I32 => f64::from(i32::from_le_bytes(four())),
            Self::U32 => f64::from(u32::from_le_bytes(four())),
            Self::F32 => f64::from(f32::from_le_bytes(four())),
            Self::F64 => {
                let mut eight = [0; 8];
                eight.copy_from_slice(&bytes[..8]);
                f64::from_le_bytes(eight)
            }
        }
    }
}

/// Type of a property: one number, or a counted list of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PropertyKind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

/// Named column of an element.
#[derive(Clone, Debug)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) kind: PropertyKind,
}

/// Named table.
#[derive(Clone, Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: usize,
    pub(super) properties: Vec<Property>,
}

impl Element {
    /// Returns the size of a row in a binary file, if all rows have the same size. [byte]
    pub(super) fn fixed_row_bytes(&self) -> Option<usize> {
        self.properties
            .iter()
            .map(|property| match property.kind {
                PropertyKind::Scalar(scalar) => Some(scalar.bytes()),
                PropertyKind::List { .. } => None,
            })
            .sum()
    }

    /// Returns the minimum size of a row in a binary file, with empty lists. [byte]
    pub(super) fn min_row_bytes(&self) -> usize {
        self.properties
            .iter()
            .map(|property| match property.kind {
                PropertyKind::Scalar(scalar) | PropertyKind::List { count: scalar, .. } => {
                    scalar.bytes()
                }
            })
            .sum()
    }
}

/// Parsed header.
#[derive(Clone, Debug)]
pub(super) struct Header {
    pub(super) format: Format,
    /// Elements in file order; exactly one is named [`VERTEX`].
    pub(super) elements: Vec<Element>,
    /// Whether a comment indicates training with anti-aliasing.
    pub(super) antialiased: bool,
    /// Start of the rows. [byte]
    pub(super) body: usize,
}

impl Header {
    /// Parses the header of a PLY file.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, PlyError> {
        let mut lines = Lines { bytes: &bytes[..bytes.len().min(MAX_HEADER_BYTES)], offset: 0 };
        if !matches!(lines.next(), Some((_, "ply"))) {
            let start = &bytes[..bytes.len().min(16)];
            return Err(PlyError::NotPly { found: String::from_utf8_lossy(start).into() });
        }
        let mut format = None;
        let mut antialiased = false;
        let mut elements: Vec<Element> = Vec::new();
        loop {
            let Some((offset, line)) = lines.next() else {
                return Err(PlyError::Header {
                    offset: lines.offset,
                    reason:
                        "no `end_header` line in plain text; the file is truncated or not a PLY"
                            .into(),
                });
            };
            let fail = |reason: String| PlyError::Header { offset, reason };
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["comment", ref comment @ ..] => {
                    // The last matching comment wins, as in brush and splat-transform.
                    antialiased = says_antialiased(comment).unwrap_or(antialiased);
                }
                [] | ["obj_info", ..] => {}
                ["end_header"] => break,
                ["format", name, _version] => {
                    format = Some(match name {
                        "binary_little_endian" => Format::BinaryLittleEndian,
                        "ascii" => Format::Ascii,
                        _ => {
                            return Err(fail(format!(
                                "format `{name}`; only binary_little_endian and ascii are read: save it as one of \
                                 them"
                            )));
                        }
                    });
                }
                ["element", name, count] => {
                    let count = count.parse().map_err(|_| {
                        fail(format!("element `{name}` has count `{count}`, not a whole number"))
                    })?;
                    if elements.iter().any(|element| element.name == name) {
                        return Err(fail(format!("element `{name}` is declared twice")));
                    }
                    elements.push(Element { name: name.into(), count, properties: Vec::new() });
                }
                ["property", ref kind @ .., name] if !kind.is_empty() => {
                    let scalar = |name: &str| {
                        Scalar::from_name(name)
                            .ok_or_else(|| fail(format!("unknown property type `{name}`")))
                    };
                    let kind = match *kind {
                        [single] => PropertyKind::Scalar(scalar(single)?),
                        ["list", count, item] => {
                            PropertyKind::List { count: scalar(count)?, item: scalar(item)? }
                        }
                        _ => return Err(fail(format!("cannot read `{line}`"))),
                    };
                    let Some(element) = elements.last_mut() else {
                        return Err(fail(format!("property `{name}` before any element")));
                    };
                    if element.properties.iter().any(|property| property.name == name) {
                        return Err(fail(format!("property `{name}` is declared twice")));
                    }
                    element.properties.push(Property { name: name.into(), kind });
                }
                _ => return Err(fail(format!("cannot read `{line}`"))),
            }
        }
        let Some(format) = format else {
            return Err(PlyError::Header {
                offset: lines.offset,
                reason: "no `format` line before `end_header`".into(),
            });
        };
        if !elements.iter().any(|element| element.name == VERTEX) {
            return Err(PlyError::NotSplats {
                reason: format!("the file has no element `{VERTEX}`"),
            });
        }
        Ok(Self { format, elements, antialiased, body: lines.offset })
    }

    /// Returns the element with one row per splat.
    pub(super) fn vertex(&self) -> &Element {
        // `parse` has rejected files without this element.
        &self.elements[self.elements.iter().position(|e| e.name == VERTEX).unwrap_or(0)]
    }
}

/// Comment that indicates anti-aliasing, as brush writes it.
pub(super) const ANTIALIASED: &str = "comment SplatRenderMode: mip\n";

/// Returns whether a comment indicates anti-aliasing, or `None` if it is another comment.
fn says_antialiased(comment: &[&str]) -> Option<bool> {
    let [key, value] = comment else { return None };
    let is = |word: &str, expected: &str| word.eq_ignore_ascii_case(expected);
    if is(key, "SplatRenderMode:") {
        if is(value, "mip") {
            return Some(true);
        }
        return is(value, "default").then_some(false);
    }
    if is(key, "antialiased") {
        return match *value {
            "1" => Some(true),
            "0" => Some(false),
            _ => None,
        };
    }
    None
}

/// Iterator over lines of text with their offsets. It ends at the first line that is incomplete or
/// not UTF-8.
struct Lines<'a> {
    bytes: &'a [u8],
    offset: usize,
}

impl<'a> Lines<'a> {
    fn next(&mut self) -> Option<(usize, &'a str)> {
        let start = self.offset;
        let length = self.bytes[start..].iter().position(|&byte| byte == b'\n')?;
        let line = str::from_utf8(&self.bytes[start..start + length]).ok()?;
        self.offset = start + length + 1;
        Some((start, line.strip_suffix('\r').unwrap_or(line)))
    }
}
