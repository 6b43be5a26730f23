//! A distance field as bytes, for caches: a header, then one byte a voxel, then one bit a voxel where some are
//! unseen.
//!
//! Read with suspicion: a field that is wrong is a vehicle that hits something. Whoever keeps the
//! bytes guards them with a checksum of their own.

use glam::DVec3;

use super::DistanceField;
use crate::grid::Grid;

/// Why bytes are no distance field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FieldError {
    /// Another file, or another version of this one.
    #[error("these bytes are no distance field of this version")]
    Other,
    /// A number that cannot be.
    #[error("the distance field's {0} cannot be; bake it anew")]
    Number(&'static str),
    /// Too few or too many.
    #[error(
        "the distance field has {found} bytes of voxels, and should have {expected}; bake it anew"
    )]
    Length {
        /// Bytes there are.
        found: usize,
        /// Bytes by the header.
        expected: usize,
    },
}

impl DistanceField {
    /// Returns the bytes that [`Self::from_bytes`] reads: the header, the voxels apart from it, as they may be
    /// hundreds of megabytes, and which of them are unseen, if any is.
    pub fn as_bytes(&self) -> ([u8; FIELD_HEADER], &[u8], &[u8]) {
        let Self { grid, codes, floor_z_m, unseen } = self;
        let mut header = [0; FIELD_HEADER];
        let numbers = [grid.min_m.x, grid.min_m.y, grid.min_m.z, grid.voxel_m, *floor_z_m];
        let sizes = grid.size.map(|n| n as u64);
        let words = numbers.map(f64::to_le_bytes).into_iter().chain(sizes.map(u64::to_le_bytes));
        header[..8].copy_from_slice(MAGIC);
        for (place, word) in header[8..].chunks_exact_mut(8).zip(words) {
            place.copy_from_slice(&word);
        }
        (header, codes, unseen)
    }

    /// Reads what [`Self::as_bytes`] returned, joined.
    ///
    /// # Errors
    /// [`FieldError`] for anything else. Allocates no more than `bytes` holds.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, FieldError> {
        let (header, voxels) =
            bytes.split_first_chunk::<FIELD_HEADER>().ok_or(FieldError::Other)?;
        let (magic, words) = header.split_at(8);
        if magic != MAGIC {
            return Err(FieldError::Other);
        }
        let word = |n: usize| -> [u8; 8] { words[8 * n..8 * n + 8].try_into().unwrap_or_default() };
        let number = |n: usize| f64::from_le_bytes(word(n));
        let min_m = DVec3::new(number(0), number(1), number(2));
        let (voxel_m, floor_z_m) = (number(3), number(4));
        if !(min_m.is_finite() && min_m.abs().max_element() < FURTHEST_M) {
            return Err(FieldError::Number("corner"));
        }
        if !(VOXELS_M.contains(&voxel_m)) {
            return Err(FieldError::Number("size of a voxel"));
        }
        if !(floor_z_m.is_finite() && floor_z_m.abs() < FURTHEST_M) {
            return Err(FieldError::Number("floor"));
        }
        let sizes = [5, 6, 7].map(|n| usize::try_from(u64::from_le_bytes(word(n))).ok());
        let [Some(nx), Some(ny), Some(nz)] = sizes else {
            return Err(FieldError::Number("number of voxels"));
        };
        let expected = nx.checked_mul(ny).and_then(|plane| plane.checked_mul(nz));
        match expected {
            None | Some(0) => Err(FieldError::Number("number of voxels")),
            Some(expected) => {
                // All of one, or of the other too.
                let rest = voxels.len().checked_sub(expected);
                if rest.is_none_or(|rest| rest > 0 && rest != expected.div_ceil(8)) {
                    return Err(FieldError::Length { found: voxels.len(), expected });
                }
                let (codes, unseen) = voxels.split_at(expected);
                let grid = Grid { min_m, voxel_m, size: [nx, ny, nz] };
                Ok(Self { grid, codes: codes.to_vec(), floor_z_m, unseen: unseen.to_vec() })
            }
        }
    }
}

/// Bytes before the voxels.
pub const FIELD_HEADER: usize = 72;
/// The last is the version: raise it when bytes or codes mean something else.
const MAGIC: &[u8; 8] = b"vzfield\x01";
/// Well beyond what an arena may hold. [m]
const FURTHEST_M: f64 = 1e5;
/// What an arena may hold, and more. [m]
const VOXELS_M: std::ops::RangeInclusive<f64> = 1e-3..=10.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occupancy::occupancy_of;
    use proptest::prelude::*;

    fn field(size_m: DVec3) -> DistanceField {
        let grid =
            Grid::covering(DVec3::new(-1.0, 0.5, 0.0), DVec3::new(-1.0, 0.5, 0.0) + size_m, 0.1);
        DistanceField::of(occupancy_of(grid, 0.25, |p| p.x + p.y < 0.3))
    }

    fn bytes(field: &DistanceField) -> Vec<u8> {
        let (header, codes, unseen) = field.as_bytes();
        [&header[..], codes, unseen].concat()
    }

    #[test]
    fn reports_errors_by_name() {
        let good = bytes(&field(DVec3::ONE));
        let check = |at: usize, new: &[u8], expected: &str| {
            let mut bad = good.clone();
            bad[at..at + new.len()].copy_from_slice(new);
            let error = DistanceField::from_bytes(&bad).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check(0, b"V", "no distance field");
        check(7, b"\x02", "of this version");
        check(8, &f64::NAN.to_le_bytes(), "corner");
        check(32, &0f64.to_le_bytes(), "size of a voxel");
        check(40, &f64::INFINITY.to_le_bytes(), "floor");
        check(48, &u64::MAX.to_le_bytes(), "number of voxels");
        check(48, &0u64.to_le_bytes(), "number of voxels");
        check(48, &11u64.to_le_bytes(), "has 1000 bytes of voxels, and should have 1100");
        assert!(DistanceField::from_bytes(&good[..good.len() - 1]).is_err());
        assert_eq!(DistanceField::from_bytes(&[]), Err(FieldError::Other));
    }

    proptest! {
        #[test]
        fn a_field_reads_back(size in prop::array::uniform3(0.05..1.5f64)) {
            let field = field(DVec3::from(size));
            prop_assert_eq!(DistanceField::from_bytes(&bytes(&field)).unwrap(), field);
        }

        #[test]
        fn any_bytes_are_an_error_or_a_sound_field(tail in prop::collection::vec(any::<u8>(), 0..200)) {
            let any = [&MAGIC[..], &tail].concat();
            if let Ok(field) = DistanceField::from_bytes(&any) {
                prop_assert!(field.distance_m(DVec3::ZERO).is_finite());
            }
        }
    }
}
