//! cameras.bin, images.bin, points3D.bin: a count, then little-endian records.

use std::collections::HashMap;

use glam::{DVec2, DVec3};

use super::{Cameras, ColmapError, lens};
use crate::dataset::sparse::{SparseImage, SparsePoint, SparseSighting, pose};

/// Reader of the remaining bytes.
struct Bytes<'a> {
    rest: &'a [u8],
    whole: usize,
}

impl<'a> Bytes<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, whole: bytes.len() }
    }

    fn damaged(&self, what: &str) -> ColmapError {
        ColmapError::Damaged(format!("at byte {}: {what}", self.whole - self.rest.len()))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], ColmapError> {
        let Some((bytes, rest)) = self.rest.split_first_chunk::<N>() else {
            return Err(self.damaged("the file ends within a record; was it copied whole?"));
        };
        self.rest = rest;
        Ok(*bytes)
    }

    fn u64(&mut self) -> Result<u64, ColmapError> {
        self.take().map(u64::from_le_bytes)
    }

    fn i32(&mut self) -> Result<i32, ColmapError> {
        self.take().map(i32::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], ColmapError> {
        let mut out = [0.0; N];
        for value in &mut out {
            *value = f64::from_le_bytes(self.take()?);
        }
        Ok(out)
    }

    /// Reads the number of the following records, of at least `least` bytes each.
    fn count(&mut self, least: usize) -> Result<usize, ColmapError> {
        let count = self.u64()?;
        let fits = usize::try_from(count)
            .ok()
            .filter(|n| n.checked_mul(least).is_some_and(|bytes| bytes <= self.rest.len()));
        fits.ok_or_else(|| {
            self.damaged(&format!("{count} records do not fit into {} bytes", self.rest.len()))
        })
    }

    fn id(&mut self, what: &str) -> Result<u32, ColmapError> {
        let id = self.i32()?;
        u32::try_from(id).map_err(|_| self.damaged(&format!("{what} has the id {id}")))
    }

    /// Skips records.
    fn skip(&mut self, count: usize, size: usize) {
        self.rest = &self.rest[count * size..];
    }

    fn end(&self) -> Result<(), ColmapError> {
        if self.rest.is_empty() {
            return Ok(());
        }
        Err(self.damaged(&format!("{} bytes follow the last record", self.rest.len())))
    }
}

/// Reads cameras.bin.
pub fn cameras(bytes: &[u8]) -> Result<Cameras, ColmapError> {
    let mut bytes = Bytes::new(bytes);
    let mut cameras = Cameras::new();
    for _ in 0..bytes.count(24)? {
        let id = bytes.id("a camera")?;
        let (model, parameters) = lens::of_number(bytes.i32()?)?;
        let (width, height) = (bytes.u64()?, bytes.u64()?);
        let mut values = Vec::with_capacity(parameters);
        for _ in 0..parameters {
            values.extend(bytes.f64s::<1>()?);
        }
        cameras.insert(id, lens::intrinsics(model, width, height, &values)?);
    }
    bytes.end()?;
    Ok(cameras)
}

/// Reads images.bin.
pub fn images(bytes: &[u8], cameras: &Cameras) -> Result<Vec<SparseImage>, ColmapError> {
    let mut bytes = Bytes::new(bytes);
    let mut images = Vec::new();
    for _ in 0..bytes.count(73)? {
        bytes.id("an image")?;
        let (rotation, translation) = (bytes.f64s::<4>()?, bytes.f64s::<3>()?);
        let camera = bytes.id("a camera")?;
        let Some(end) = bytes.rest.iter().position(|&byte| byte == 0) else {
            return Err(bytes.damaged("an image's name does not end"));
        };
        let Ok(name) = std::str::from_utf8(&bytes.rest[..end]) else {
            return Err(bytes.damaged("an image's name is not UTF-8"));
        };
        let name = name.to_owned();
        bytes.rest = &bytes.rest[end + 1..];
        let Some(world_from_cam) = pose(rotation, translation) else {
            return Err(bytes.damaged(&format!("{name} has no rotation and translation")));
        };
        let Some(&intrinsics) = cameras.get(&camera) else {
            return Err(bytes.damaged(&format!("{name}: camera {camera} is not among the cameras")));
        };
        let mut seen = Vec::new();
        for _ in 0..bytes.count(24)? {
            let pixel = DVec2::from_array(bytes.f64s()?);
            // An id of all ones means no point.
            let point = bytes.u64()?;
            let is_point = point != u64::MAX && pixel.is_finite();
            seen.extend(is_point.then_some(SparseSighting { point, pixel }));
        }
        images.push(SparseImage { name, intrinsics, world_from_cam, seen });
    }
    bytes.end()?;
    Ok(images)
}

/// Reads points3D.bin.
pub fn points(bytes: &[u8]) -> Result<HashMap<u64, SparsePoint>, ColmapError> {
    let mut bytes = Bytes::new(bytes);
    let mut points = HashMap::new();
    for _ in 0..bytes.count(51)? {
        let id = bytes.u64()?;
        let position = DVec3::from_array(bytes.f64s::<3>()?);
        let rgb = bytes.take::<3>()?;
        bytes.f64s::<1>()?;
        let track = bytes.count(8)?;
        bytes.skip(track, 8);
        if position.is_finite() {
            points.insert(id, SparsePoint { position, rgb, track });
        }
    }
    bytes.end()?;
    Ok(points)
}
