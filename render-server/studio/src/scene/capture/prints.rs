//! Printed tags in pictures. Their numbers identify places, and their corners define the scale.

use std::path::Path;

use anyhow::{Context, Result, anyhow};
use glam::DVec2;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_tags::capture;
use vizflyt_tags::detect::{Detector, DetectorSettings};
use vizflyt_tags::family::TagFamily;

use super::images::Pictures;
use crate::scene::progress::Progress;

/// Tags in all pictures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Seen {
    /// Distinct tags.
    pub(super) tags: Vec<Print>,
    /// Sightings in each picture, in their order.
    pub(super) pictures: Vec<Vec<Sighting>>,
    /// Names of the pictures, in the same order.
    pub(super) names: Vec<String>,
}

/// Identity of a printed tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Print {
    pub(super) family: TagFamily,
    pub(super) id: u32,
}

/// A tag in a picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Sighting {
    /// Index in [`Seen::tags`].
    pub(super) tag: usize,
    /// Corners: lower left, lower right, upper right, upper left. [px]
    pub(super) corners_px: [[f64; 2]; 4],
}

impl Sighting {
    /// Returns the corners as vectors. [px]
    pub(super) fn corners(&self) -> [DVec2; 4] {
        self.corners_px.map(DVec2::from_array)
    }
}

impl Seen {
    /// Returns the tags in the picture with this name.
    pub(super) fn of(&self, name: &str) -> &[Sighting] {
        let index = self.names.iter().position(|known| known == name);
        index.and_then(|index| self.pictures.get(index)).map_or(&[], Vec::as_slice)
    }

    /// Returns the number of pictures with tags.
    pub(super) fn with_tags(&self) -> usize {
        self.pictures.iter().filter(|tags| !tags.is_empty()).count()
    }
}

/// Detects tags in all pictures. `lens` provides the distortion of straight edges.
pub(super) fn look(pictures: &Pictures, families: &[TagFamily], lens: &Intrinsics) -> Result<Seen> {
    let mut detector = Detector::new(families, DetectorSettings::default());
    let mut progress = Progress::new("");
    let names = pictures.pictures.iter().map(|picture| picture.name.clone()).collect();
    let mut seen = Seen { tags: Vec::new(), pictures: Vec::new(), names };
    let count = pictures.pictures.len();
    for (number, picture) in pictures.pictures.iter().enumerate() {
        progress.show(number as f64 / count as f64, || {
            format!("looking for tags in picture {number} of {count}")
        });
        let image = grey(&pictures.folder.join(&picture.name))?;
        let found = detector.search(&image, lens, true);
        let sightings = found.iter().map(|found| {
            let print = Print { family: found.family, id: found.id };
            let known = seen.tags.iter().position(|tag| *tag == print);
            let tag = known.unwrap_or_else(|| {
                seen.tags.push(print);
                seen.tags.len() - 1
            });
            Sighting { tag, corners_px: found.corners_px.map(|corner| corner.to_array()) }
        });
        let sightings = sightings.collect();
        seen.pictures.push(sightings);
    }
    Ok(seen)
}

fn grey(path: &Path) -> Result<vizflyt_tags::image::Gray> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    capture::decode(&bytes).map_err(|why| anyhow!("{}: {why}", path.display()))
}
