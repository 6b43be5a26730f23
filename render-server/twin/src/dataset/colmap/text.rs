//! cameras.txt, images.txt, points3D.txt: one record per line, two lines per image; `#` starts a comment.

use std::collections::HashMap;
use std::str::{FromStr, SplitWhitespace};

use glam::{DVec2, DVec3};

use super::{Cameras, ColmapError, lens};
use crate::dataset::sparse::{SparseImage, SparsePoint, SparseSighting, pose};

/// Fields of a line, with its number for messages.
struct Line<'a> {
    number: usize,
    fields: SplitWhitespace<'a>,
}

impl<'a> Line<'a> {
    fn damaged(&self, what: &str) -> ColmapError {
        ColmapError::Damaged(format!("line {}: {what}", self.number))
    }

    fn text(&mut self, what: &str) -> Result<&'a str, ColmapError> {
        self.fields.next().ok_or_else(|| self.damaged(&format!("{what} is missing")))
    }

    fn value<T: FromStr>(&mut self, what: &str) -> Result<T, ColmapError> {
        let text = self.text(what)?;
        text.parse().map_err(|_| self.damaged(&format!("{what} is '{text}', not a valid number")))
    }

    fn values<const N: usize>(&mut self, what: &str) -> Result<[f64; N], ColmapError> {
        let mut out = [0.0; N];
        for value in &mut out {
            *value = self.value(what)?;
        }
        Ok(out)
    }
}

/// Returns all lines except comments, including blank ones.
fn lines(text: &str) -> impl Iterator<Item = Line<'_>> {
    let all = text.lines().enumerate().filter(|(_, line)| !line.starts_with('#'));
    all.map(|(i, line)| Line { number: i + 1, fields: line.split_whitespace() })
}

/// Returns all lines except comments and blank ones.
fn records(text: &str) -> impl Iterator<Item = Line<'_>> {
    lines(text).filter(|line| line.fields.clone().next().is_some())
}

/// Reads cameras.txt.
pub fn cameras(text: &str) -> Result<Cameras, ColmapError> {
    let mut cameras = Cameras::new();
    for mut line in records(text) {
        let id = line.value("the camera's id")?;
        let model = line.text("the camera's model")?;
        let (width, height) = (line.value("the width")?, line.value("the height")?);
        let mut parameters = Vec::new();
        while line.fields.clone().next().is_some() && parameters.len() < 32 {
            parameters.push(line.value("a parameter")?);
        }
        let camera = lens::intrinsics(model, width, height, &parameters).map_err(|e| match e {
            ColmapError::Damaged(what) => line.damaged(&what),
            lens @ ColmapError::Lens(_) => lens,
        })?;
        cameras.insert(id, camera);
    }
    Ok(cameras)
}

/// Reads images.txt.
pub fn images(text: &str, cameras: &Cameras) -> Result<Vec<SparseImage>, ColmapError> {
    let mut images = Vec::new();
    let mut lines = lines(text);
    while let Some(mut line) = lines.next() {
        if line.fields.clone().next().is_none() {
            continue;
        }
        let _id: u32 = line.value("the image's id")?;
        let rotation = line.values::<4>("the rotation")?;
        let translation = line.values::<3>("the translation")?;
        let camera: u32 = line.value("the camera's id")?;
        let first = line.text("the image's name")?;
        // Names may contain spaces.
        let name = std::iter::once(first).chain(line.fields.by_ref()).collect::<Vec<_>>().join(" ");
        let Some(world_from_cam) = pose(rotation, translation) else {
            return Err(line.damaged("no rotation and translation"));
        };
        let Some(&intrinsics) = cameras.get(&camera) else {
            return Err(line.damaged(&format!("camera {camera} is not among the cameras")));
        };
        // The second line exists even if the image sees no points.
        let mut seen = Vec::new();
        if let Some(mut points) = lines.next() {
            while points.fields.clone().next().is_some() {
                let pixel = DVec2::from_array(points.values("a point's pixel")?);
                // An id of -1 means no point.
                let id: i64 = points.value("a point's id")?;
                let point = u64::try_from(id).ok().filter(|_| pixel.is_finite());
                seen.extend(point.map(|point| SparseSighting { point, pixel }));
            }
        }
        images.push(SparseImage { name, intrinsics, world_from_cam, seen });
    }
    Ok(images)
}

/// Reads points3D.txt.
pub fn points(text: &str) -> Result<HashMap<u64, SparsePoint>, ColmapError> {
    let mut points = HashMap::new();
    for mut line in records(text) {
        let id = line.value("the point's id")?;
        let position = DVec3::from_array(line.values::<3>("the position")?);
        let mut rgb = [0u8; 3];
        for value in &mut rgb {
            *value = line.value("the colour")?;
        }
        let _: f64 = line.value("the error")?;
        let track = line.fields.clone().count() / 2;
        if position.is_finite() {
            points.insert(id, SparsePoint { position, rgb, track });
        }
    }
    Ok(points)
}
