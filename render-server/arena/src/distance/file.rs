//! Serialization of a distance field, for caches: a header, one byte per voxel, then one bit per voxel if some
//! are unseen.
//!
//! The reader validates everything: a wrong field means a collision. The owner of the bytes must protect them
//! with a checksum.

use glam::DVec3;

use super::DistanceField;
use crate::grid::Grid;

/// Reason for rejecting the bytes of a distance field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FieldError {
    /// Another kind of file, or another version.
    #[error("not a distance field of this version")]
    Other,
    /// A number out of range.
    #[error("the distance field's {0} is out of range; bake it again")]
    Number(&'static str),
    /// Wrong number of bytes.
    #[error(
        "the distance field has {found} bytes of voxels, and should have {expected}; bake it again"
    )]
    Length {
        found: usize,
        /// Number of bytes according to the header.
        expected: usize,
    },
}

impl DistanceField {
    /// Returns the bytes for [`Self::from_bytes`]: the header, the voxels (separate, because they may be
    /// hundreds of megabytes), and the bits of unseen voxels, if there are any.
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

    /// Reads the concatenated result of [`Self::as_bytes`].
    ///
    /// # Errors
    /// [`FieldError`] for any other bytes. Allocates at most the length of `bytes`.
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
                // Distances only, or distances and unseen bits.
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

/// Number of bytes before the voxels.
pub const FIELD_HEADER: usize = 72;
/// The last byte is the version: increase it if the meaning of bytes or codes changes.
const MAGIC: &[u8; 8] = b"vzfield\x01";
/// Far beyond the limits of an arena. [m]
const FURTHEST_M: f64 = 1e5;
/// Wider than the limits of an arena. [m]
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
        check(0, b"V", "not a distance field");
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
        fn field_round_trips(size in prop::array::uniform3(0.05..1.5f64)) {
            let field = field(DVec3::from(size));
            prop_assert_eq!(DistanceField::from_bytes(&bytes(&field)).unwrap(), field);
        }

        #[test]
        fn any_bytes_give_an_error_or_a_valid_field(tail in prop::collection::vec(any::<u8>(), 0..200)) {
            let any = [&MAGIC[..], &tail].concat();
            if let Ok(field) = DistanceField::from_bytes(&any) {
                prop_assert!(field.distance_m(DVec3::ZERO).is_finite());
            }
        }
    }
}
