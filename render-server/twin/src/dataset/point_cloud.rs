//! PLY files of coloured points, as in nerfstudio's datasets.

use glam::DVec3;

/// Position and sRGB colour of a point.
pub type CloudPoint = (DVec3, [u8; 3]);

/// Storage type of a property.
#[derive(Clone, Copy)]
enum ScalarType {
    Integer { bytes: usize, signed: bool },
    Float { bytes: usize },
}

impl ScalarType {
    fn of(name: &str) -> Option<Self> {
        let integer = |bytes, signed| Some(Self::Integer { bytes, signed });
        match name {
            "char" | "int8" => integer(1, true),
            "uchar" | "uint8" => integer(1, false),
            "short" | "int16" => integer(2, true),
            "ushort" | "uint16" => integer(2, false),
            "int" | "int32" => integer(4, true),
            "uint" | "uint32" => integer(4, false),
            "float" | "float32" => Some(Self::Float { bytes: 4 }),
            "double" | "float64" => Some(Self::Float { bytes: 8 }),
            _ => None,
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::Integer { bytes, .. } | Self::Float { bytes } => bytes,
        }
    }

    /// Returns the value of little-endian bytes.
    fn number(self, bytes: &[u8]) -> f64 {
        let mut eight = [0; 8];
        eight[..bytes.len()].copy_from_slice(bytes);
        match self {
            Self::Float { bytes: 4 } => f64::from(f32::from_bits(u64::from_le_bytes(eight) as u32)),
            Self::Float { .. } => f64::from_le_bytes(eight),
            Self::Integer { bytes, signed } => {
                let value = u64::from_le_bytes(eight);
                let sign = 64 - 8 * bytes as u32;
                if signed { ((value << sign) as i64 >> sign) as f64 } else { value as f64 }
            }
        }
    }
}

/// Reads the vertices of a PLY: `x`, `y`, `z`, and `red`, `green`, `blue` if present.
pub fn parse(bytes: &[u8]) -> Result<Vec<CloudPoint>, String> {
    const END: &[u8] = b"end_header";
    let end = bytes.windows(END.len()).take(MAX_HEADER).position(|window| window == END);
    let end = end.ok_or("not a PLY: its header does not end")?;
    let header =
        std::str::from_utf8(&bytes[..end]).map_err(|_| "not a PLY: its header is not text")?;
    let after = bytes[end..].iter().position(|&byte| byte == b'\n');
    let body = after.map_or(&[][..], |at| &bytes[end + at + 1..]);
    let mut lines = header.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    if lines.next().as_deref() != Some(&["ply"]) {
        return Err("not a PLY: it does not begin with 'ply'".to_owned());
    }
    let (mut is_text, mut count, mut elements) = (None, 0usize, 0);
    let mut properties: Vec<(String, ScalarType)> = Vec::new();
    for line in lines {
        match line.as_slice() {
            ["format", "ascii", _] => is_text = Some(true),
            ["format", "binary_little_endian", _] => is_text = Some(false),
            ["format", other, ..] => return Err(format!("the format {other} is not understood")),
            ["element", name, number] => {
                elements += 1;
                if elements == 1 {
                    if *name != "vertex" {
                        return Err(format!("the first element is '{name}', not 'vertex'"));
                    }
                    count = number.parse().map_err(|_| format!("'{number}' vertices"))?;
                }
            }
            ["property", kind, name] if elements == 1 => {
                let kind =
                    ScalarType::of(kind).ok_or_else(|| format!("property {name} is a '{kind}'"))?;
                properties.push(((*name).to_owned(), kind));
            }
            ["property", ..] if elements == 1 => return Err("a vertex has a list".to_owned()),
            _ => {}
        }
    }
    let place = |name: &str| properties.iter().position(|(known, _)| known == name);
    let required = |name: &str| place(name).ok_or_else(|| format!("vertices have no {name}"));
    let position = [required("x")?, required("y")?, required("z")?];
    let colour = [place("red"), place("green"), place("blue")];
    let mut points = Vec::new();
    let mut add = |row: &[f64]| {
        let p = DVec3::from_array(position.map(|at| row[at]));
        let rgb = colour.map(|at| at.map_or(128.0, |at| row[at]).clamp(0.0, 255.0) as u8);
        if p.is_finite() {
            points.push((p, rgb));
        }
    };
    let mut row = vec![0.0; properties.len()];
    if is_text.ok_or("its format is not given")? {
        let text = std::str::from_utf8(body).map_err(|_| "the points are not text")?;
        let mut numbers = text.split_whitespace();
        for i in 0..count {
            for value in &mut row {
                let text =
                    numbers.next().ok_or_else(|| format!("it ends at point {i} of {count}"))?;
                *value =
                    text.parse().map_err(|_| format!("point {i}: '{text}' is not a number"))?;
            }
            add(&row);
        }
    } else {
        let size: usize = properties.iter().map(|(_, kind)| kind.bytes()).sum();
        if count.checked_mul(size).is_none_or(|needed| needed > body.len()) {
            return Err(format!("{count} points do not fit into its {} bytes", body.len()));
        }
        for bytes in body.chunks_exact(size).take(count) {
            let mut at = 0;
            for (value, (_, kind)) in row.iter_mut().zip(&properties) {
                *value = kind.number(&bytes[at..at + kind.bytes()]);
                at += kind.bytes();
            }
            add(&row);
        }
    }
    Ok(points)
}

/// Maximum length of a header. [B]
const MAX_HEADER: usize = 1 << 16;

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "element vertex 2\nproperty float x\nproperty float y\nproperty double z\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 0\nend_header\n";

    #[test]
    fn reads_text_and_binary_alike() {
        let text = format!("ply\nformat ascii 1.0\n{HEADER}1 2 3 4 5 6\n-1 0.5 0 255 0 9\n");
        let mut binary = format!("ply\nformat binary_little_endian 1.0\n{HEADER}").into_bytes();
        for (x, y, z, rgb) in [(1f32, 2f32, 3f64, [4u8, 5, 6]), (-1.0, 0.5, 0.0, [255, 0, 9])] {
            binary.extend(x.to_le_bytes());
            binary.extend(y.to_le_bytes());
            binary.extend(z.to_le_bytes());
            binary.extend(rgb);
        }
        let points = parse(text.as_bytes()).unwrap();
        assert_eq!(
            points,
            [(DVec3::new(1.0, 2.0, 3.0), [4, 5, 6]), (DVec3::new(-1.0, 0.5, 0.0), [255, 0, 9])]
        );
        assert_eq!(parse(&binary).unwrap(), points);
        for len in 0..binary.len() {
            assert!(parse(&binary[..len]).is_err(), "{len} bytes");
        }
    }

    #[test]
    fn error_names_the_fault() {
        for (text, says) in [
            ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "no y"),
            ("ply\nformat binary_big_endian 1.0\nend_header\n", "binary_big_endian"),
            ("plx\nend_header\n", "begin"),
            (
                "ply\nformat ascii 1.0\nelement vertex 9999999999999\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
                "ends at point 0",
            ),
        ] {
            let error = parse(text.as_bytes()).unwrap_err();
            assert!(error.contains(says), "{error}");
        }
    }
}
