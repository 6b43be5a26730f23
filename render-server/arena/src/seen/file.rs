//! Serialization of seen space: a header, one bit per voxel, a checksum.
//!
//! ```text
//! 8 magic, version | 32 SHA-256 of the scene | 11 f64: rotation xyzw, metres per unit, origin, corner | ...
//! ... f64 voxel | 3 u64 voxels along x, y, z | bits | u64 FNV-1a of all before
//! ```
//! All numbers are little-endian. The reader validates everything: a wrong bit may let a vehicle fly into a
//! wall.

use glam::{DQuat, DVec3};

use super::{ScenePlace, SeenSpace};
use crate::config::METRES_PER_UNIT;
use crate::grid::Grid;

/// Reason for rejecting the bytes of seen space. The solution is always to carve the scene again.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SeenError {
    /// Another kind of file, or another version.
    #[error("not seen space of this version; carve the scene again")]
    Other,
    /// A number out of range.
    #[error("its {0} is out of range; carve the scene again")]
    Number(&'static str),
    /// Wrong number of bytes.
    #[error("it has {found} bytes, and should have {expected}; carve the scene again")]
    Length {
        found: usize,
        /// Number of bytes according to the header.
        expected: usize,
    },
    /// The bytes were changed.
    #[error("its checksum does not match: it is damaged; carve the scene again")]
    Checksum,
}

impl SeenSpace {
    /// Returns the bytes for [`Self::from_bytes`].
    pub fn to_bytes(&self) -> Vec<u8> {
        let ScenePlace { rotation, metres_per_unit, origin_m } = self.place;
        let mut bytes = Vec::with_capacity(HEADER + self.bits.len() + 8);
        bytes.extend(MAGIC);
        bytes.extend(self.scene);
        let numbers = rotation.to_array().into_iter().chain([metres_per_unit]);
        let numbers = numbers.chain(origin_m.to_array()).chain(self.grid.min_m.to_array());
        bytes.extend(numbers.chain([self.grid.voxel_m]).flat_map(f64::to_le_bytes));
        bytes.extend(self.grid.size.into_iter().flat_map(|n| (n as u64).to_le_bytes()));
        bytes.extend(&self.bits);
        bytes.extend(fnv1a(&bytes).to_le_bytes());
        bytes
    }

    /// Reads the result of [`Self::to_bytes`].
    ///
    /// # Errors
    /// [`SeenError`] for any other bytes. Allocates at most the length of `bytes`.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SeenError> {
        let (header, rest) = bytes.split_first_chunk::<HEADER>().ok_or(SeenError::Other)?;
        if header[..8] != MAGIC[..] {
            return Err(SeenError::Other);
        }
        let mut scene = [0; 32];
        scene.copy_from_slice(&header[8..40]);
        let word =
            |n: usize| -> [u8; 8] { header[40 + 8 * n..48 + 8 * n].try_into().unwrap_or_default() };
        let number = |n: usize| f64::from_le_bytes(word(n));
        let vector = |n: usize| DVec3::new(number(n), number(n + 1), number(n + 2));
        let rotation = DQuat::from_xyzw(number(0), number(1), number(2), number(3));
        let (metres_per_unit, origin_m, min_m, voxel_m) =
            (number(4), vector(5), vector(8), number(11));
        let check = |right: bool, what| if right { Ok(()) } else { Err(SeenError::Number(what)) };
        check((rotation.length() - 1.0).abs() < 1e-6, "rotation")?;
        check(METRES_PER_UNIT.contains(&metres_per_unit), "scale")?;
        check(origin_m.abs().max_element() < FURTHEST_M && !origin_m.is_nan(), "origin")?;
        check(min_m.abs().max_element() < FURTHEST_M && !min_m.is_nan(), "corner")?;
        check(VOXELS_M.contains(&voxel_m), "size of a voxel")?;
        let sizes = [12, 13, 14].map(|n| usize::try_from(u64::from_le_bytes(word(n))).ok());
        let size = match sizes {
            [Some(nx), Some(ny), Some(nz)] => [nx, ny, nz],
            _ => return Err(SeenError::Number("number of voxels")),
        };
        let voxels = size.into_iter().try_fold(1usize, usize::checked_mul);
        let voxels = voxels.filter(|&n| n > 0).ok_or(SeenError::Number("number of voxels"))?;
        let length = voxels.div_ceil(8);
        if rest.len().checked_sub(8) != Some(length) {
            let expected = (HEADER + 8).saturating_add(length);
            return Err(SeenError::Length { found: bytes.len(), expected });
        }
        let (all, sum) = bytes.split_at(bytes.len() - 8);
        if fnv1a(all).to_le_bytes() != *sum {
            return Err(SeenError::Checksum);
        }
        let place = ScenePlace { rotation, metres_per_unit, origin_m };
        let bits = rest[..length].to_vec();
        if voxels % 8 > 0 && bits[length - 1] >> (voxels % 8) != 0 {
            return Err(SeenError::Number("last bits"));
        }
        Ok(Self { grid: Grid { min_m, voxel_m, size }, place, scene, bits })
    }
}

/// FNV-1a (Fowler, Noll, Vo), 64 bits: detects damage, not manipulation.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// The last byte is the version: increase it if the meaning of bytes changes.
const MAGIC: &[u8; 8] = b"vizseen\x01";
/// Magic, hash, 12 numbers, 3 sizes.
const HEADER: usize = 8 + 32 + 8 * 15;
/// Far beyond the limits of an arena. [m]
const FURTHEST_M: f64 = 1e6;
/// Wider than the limits of an arena. [m]
const VOXELS_M: std::ops::RangeInclusive<f64> = 1e-3..=10.0;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn place() -> ScenePlace {
        let rotation = DQuat::from_rotation_z(0.3) * DQuat::from_rotation_x(-1.2);
        ScenePlace { rotation, metres_per_unit: 0.2, origin_m: DVec3::new(1.0, -2.0, 0.5) }
    }

    /// A block of 4 x 3 x 5 voxels of 0.5 m; every third one was seen.
    fn space() -> SeenSpace {
        let grid = Grid { min_m: DVec3::new(-1.0, 0.0, 2.0), voxel_m: 0.5, size: [4, 3, 5] };
        let mut bits = vec![0; 8];
        (0..60).step_by(3).for_each(|n| bits[n / 8] |= 1 << (n % 8));
        SeenSpace::new(grid, place(), [7; 32], bits)
    }

    #[test]
    fn errors_name_the_problem() {
        let good = space().to_bytes();
        assert_eq!(SeenSpace::from_bytes(&good), Ok(space()));
        let check = |at: usize, new: &[u8], expected: &str| {
            let mut bad = good.clone();
            bad[at..at + new.len()].copy_from_slice(new);
            let error = SeenSpace::from_bytes(&bad).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check(7, b"\x02", "of this version");
        check(20, b"x", "checksum does not match");
        check(40, &f64::NAN.to_le_bytes(), "rotation");
        check(72, &0f64.to_le_bytes(), "scale");
        check(80, &f64::NAN.to_le_bytes(), "origin");
        check(104, &f64::INFINITY.to_le_bytes(), "corner");
        check(128, &0f64.to_le_bytes(), "size of a voxel");
        check(136, &u64::MAX.to_le_bytes(), "number of voxels");
        check(136, &0u64.to_le_bytes(), "number of voxels");
        check(136, &40u64.to_le_bytes(), "has 176 bytes, and should have 243");
        check(167, &[0x80], "checksum");
        let mut last = good.clone();
        last[167] |= 0x80;
        let sum = fnv1a(&last[..168]).to_le_bytes();
        last[168..].copy_from_slice(&sum);
        assert_eq!(SeenSpace::from_bytes(&last), Err(SeenError::Number("last bits")));
        for len in 0..good.len() {
            assert!(SeenSpace::from_bytes(&good[..len]).is_err());
        }
    }

    #[test]
    fn seen_space_moves_with_the_scene() {
        let (space, then) = (space(), place());
        let now = ScenePlace {
            rotation: DQuat::from_rotation_y(0.7),
            metres_per_unit: 3.0,
            origin_m: DVec3::new(10.0, 20.0, -30.0),
        };
        let at = |place: &ScenePlace, p: DVec3| {
            place.rotation * p * place.metres_per_unit + place.origin_m
        };
        let (before, after) = (space.at(&then), space.at(&now));
        let mut seen = 0;
        for n in 0..60 {
            let p_m = space.grid().center_m([n / 15, n / 5 % 3, n % 5]);
            assert_eq!(before.is_seen(p_m), n % 3 == 0, "{n}");
            let p_scene = then.rotation.inverse() * (p_m - then.origin_m) / then.metres_per_unit;
            assert_eq!(after.is_seen(at(&now, p_scene)), n % 3 == 0, "{n} after it moved");
            seen += usize::from(before.is_seen(p_m));
        }
        assert_eq!((seen, space.seen_voxels()), (20, 20));
        for p_m in [DVec3::splat(-9.0), DVec3::NAN, DVec3::splat(1e30), DVec3::new(1.01, 0.1, 2.1)]
        {
            assert!(!before.is_seen(p_m) && !after.is_seen(p_m), "{p_m}");
        }
    }

    proptest! {
        #[test]
        fn seen_space_round_trips(
            size in prop::array::uniform3(1..9usize), noise in any::<u64>(), voxel_m in 0.01..2.0f64,
        ) {
            let grid = Grid { min_m: DVec3::new(-3.0, 2.0, 0.1), voxel_m, size };
            let voxels = grid.voxels();
            let mut bits = vec![0u8; voxels.div_ceil(8)];
            for n in 0..voxels {
                bits[n / 8] |= u8::from(noise.rotate_left(n as u32) & 1 == 1) << (n % 8);
            }
            let space = SeenSpace::new(grid, place(), [noise as u8; 32], bits);
            prop_assert_eq!(SeenSpace::from_bytes(&space.to_bytes()), Ok(space));
        }

        #[test]
        fn any_bytes_give_an_error_or_valid_seen_space(tail in prop::collection::vec(any::<u8>(), 0..300)) {
            let mut any = [&MAGIC[..], &tail].concat();
            let sum = fnv1a(&any).to_le_bytes();
            any.extend(sum);
            if let Ok(space) = SeenSpace::from_bytes(&any) {
                prop_assert!(!space.at(&place()).is_seen(DVec3::splat(1e9)));
            }
        }

        #[test]
        fn rejects_one_wrong_bit(at in 0..1408usize) {
            let mut bytes = space().to_bytes();
            bytes[at / 8] ^= 1 << (at % 8);
            prop_assert!(SeenSpace::from_bytes(&bytes).is_err());
        }
    }
}
