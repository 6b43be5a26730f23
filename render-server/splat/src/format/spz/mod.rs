//! `.spz`: Niantic's compressed splats, versions 1 to 4, attribute by attribute.
//!
//! Versions 1 to 3 are one gzip stream of a 16-byte header and the attributes; version 4 is a plain
//! 32-byte header, a table of contents and one zstd stream per attribute.
//!
//! | attribute | bytes per splat | holds |
//! |---|---|---|
//! | positions | 9 (6 in version 1) | three 24-bit signed fixed-point numbers (f16 in version 1) |
//! | alphas | 1 | opacity, linear, 0 to 255 |
//! | colours | 3 | 0.5 + 0.15 times the constant harmonic, 0 to 255 |
//! | scales | 3 | natural logarithm of the standard deviation, (log + 10) * 16 |
//! | rotations | 4 (3 before version 3) | xyzw: index of the largest in the 2 upper bits, the others as sign and 9 bits; before version 3 x, y, z as 127.5 q + 127.5 with w >= 0 left out |
//! | harmonics | 3 per coefficient | 128 + 128 h, RGB within a coefficient |
//!
//! **Axes.** The file is right, up, back (RUB). A PLY of the same scene is right, down, forward,
//! and all other formats here keep the axes of the PLY. The sign of y and z is therefore changed
//! when reading and writing, as in Niantic's and PlayCanvas's converters. This rotation by half a
//! turn about x changes the sign of every basis function that is odd in (y, z).

mod read;
mod write;

pub(super) use read::decode;
pub(super) use write::encode;

/// First bytes of version 4, and of the inflated stream of earlier versions: "NGSP".
pub(super) const MAGIC: u32 = 0x5053_474e;
/// First bytes of a gzip stream.
pub(super) const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Flag: the scene was trained with anti-aliasing.
const FLAG_ANTIALIASED: u8 = 1;
/// Flag: vendor-specific records follow the header (version 4) or the attributes.
const FLAG_EXTENSIONS: u8 = 2;

/// Share of the byte's range that one unit of the constant harmonic takes.
const COLOUR_SCALE: f32 = 0.15;

/// Bytes per splat of each attribute, in the order of versions 1 to 3.
#[derive(Clone, Copy)]
struct Widths {
    positions: usize,
    alphas: usize,
    colours: usize,
    scales: usize,
    rotations: usize,
    harmonics: usize,
}

impl Widths {
    fn of(version: u32, sh_degree: u8) -> Self {
        Self {
            positions: if version == 1 { 6 } else { 9 },
            alphas: 1,
            colours: 3,
            scales: 3,
            rotations: if version < 3 { 3 } else { 4 },
            harmonics: ((usize::from(sh_degree) + 1).pow(2) - 1) * 3,
        }
    }

    fn in_order(&self) -> [usize; 6] {
        [self.positions, self.alphas, self.colours, self.scales, self.rotations, self.harmonics]
    }
}

/// Signs of the basis functions after y and z change sign. The operation is its own inverse.
const HARMONIC_SIGNS: [f32; 16] = [
    1.0, // constant
    -1.0, -1.0, 1.0, // y, z, x
    -1.0, 1.0, 1.0, -1.0, 1.0, // xy, yz, zz, xz, xx - yy
    -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0, // y, xyz, y, z, x, z, x
];

#[cfg(test)]
mod tests {
    use super::HARMONIC_SIGNS;
    use crate::harmonics::basis;

    #[test]
    fn signs_match_the_basis_rotated_about_x() {
        let direction = [0.48, -0.6, 0.64];
        let turned = [0.48, 0.6, -0.64];
        for (k, (a, b)) in basis(direction).into_iter().zip(basis(turned)).enumerate() {
            assert!((a - b * f64::from(HARMONIC_SIGNS[k])).abs() < 1e-12, "coefficient {k}");
        }
    }
}
