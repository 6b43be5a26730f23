//! Encoder of the standard binary PLY.

use std::path::Path;

use super::PlyError;
use super::header::ANTIALIASED;
use crate::Splats;
use crate::format::activate::{log_scale, logit};
use crate::format::{assert_whole, file};

/// Writes a scene as binary little-endian PLY in INRIA's layout. [`super::read`] returns the same
/// scene, except for the rounding of logarithms. The file is written under a temporary name and
/// then renamed, so that readers never see a partial file.
///
/// # Errors
/// [`PlyError::Io`] with the path.
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn write(path: impl AsRef<Path>, splats: &Splats) -> Result<(), PlyError> {
    let path = path.as_ref();
    file::replace(path, &encode(splats)).map_err(|cause| PlyError::Io {
        path: path.to_owned(),
        verb: "write",
        cause,
    })
}

/// Returns the bytes that [`write()`] writes.
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn encode(splats: &Splats) -> Vec<u8> {
    assert_whole(splats);
    let coefficients = splats.sh_coefficients();
    let count = splats.len();

    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(Into::into).into();
    names.extend((0..3).map(|i| format!("f_dc_{i}")));
    names.extend((0..(coefficients - 1) * 3).map(|i| format!("f_rest_{i}")));
    names.push("opacity".into());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    let properties: String =
        names.iter().flat_map(|name| ["property float ", name, "\n"]).collect();
    let comment = if splats.antialiased { ANTIALIASED } else { "" };
    let header = format!(
        "ply\nformat binary_little_endian 1.0\n{comment}element vertex {count}\n{properties}end_header\n"
    );

    let mut bytes = Vec::with_capacity(header.len() + count * names.len() * 4);
    bytes.extend_from_slice(header.as_bytes());
    let mut put = |value: f32| bytes.extend_from_slice(&value.to_le_bytes());
    for i in 0..count {
        splats.means_m[i].to_array().into_iter().for_each(&mut put);
        // Normals: part of the layout, without meaning for splats.
        [0.0; 3].into_iter().for_each(&mut put);
        let sh = &splats.sh[i * coefficients * 3..][..coefficients * 3];
        sh[..3].iter().copied().for_each(&mut put);
        for channel in 0..3 {
            (1..coefficients).for_each(|k| put(sh[k * 3 + channel]));
        }
        put(logit(splats.opacities[i]));
        for scale_m in splats.scales_m[i].to_array() {
            put(log_scale(scale_m));
        }
        let [x, y, z, w] = splats.rotations[i].to_array();
        [w, x, y, z].into_iter().for_each(&mut put);
    }
    bytes
}
