//! Photos in a folder. They are not copied.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use vizflyt_tags::capture;

use super::blur::blur;
use super::{Picture, Pictures};
use crate::scene::progress::Progress;

/// Returns the folder with photos: the given one or its subfolder `images`.
///
/// # Errors
/// Neither contains photos.
pub(super) fn folder(path: &Path) -> Result<PathBuf> {
    for candidate in [path.to_owned(), path.join("images")] {
        if candidate.is_dir() && !list(&candidate)?.is_empty() {
            return Ok(candidate);
        }
    }
    bail!(
        "{} holds no photos (.jpg, .jpeg, .png); convert other formats first, for example HEIC of a phone: \
         ffmpeg -i photo.heic photo.jpg",
        path.display()
    );
}

/// Returns the names of the photos in a folder, sorted.
fn list(folder: &Path) -> Result<Vec<String>> {
    let entries = std::fs::read_dir(folder)
        .with_context(|| format!("cannot read the folder {}", folder.display()))?;
    let mut names = Vec::new();
    for entry in entries {
        let path = entry.with_context(|| format!("cannot read {}", folder.display()))?.path();
        let ending = path.extension().and_then(|ending| ending.to_str()).map(str::to_lowercase);
        let is_photo = matches!(ending.as_deref(), Some("jpg" | "jpeg" | "png"));
        let name = path.file_name().and_then(|name| name.to_str());
        names.extend(name.filter(|_| is_photo).map(str::to_owned));
    }
    names.sort();
    Ok(names)
}

/// Reads size, blur and brightness of the photos of a folder.
pub(super) fn take(folder: &Path) -> Result<Pictures> {
    let names = list(folder)?;
    let mut progress = Progress::new("");
    let mut pictures = Vec::new();
    let mut size_px: Option<[u32; 2]> = None;
    for (number, name) in names.iter().enumerate() {
        let share = number as f64 / names.len() as f64;
        progress.show(share, || format!("looking at photo {number} of {}", names.len()));
        let path = folder.join(name);
        let bytes =
            std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let image = match capture::decode(&bytes) {
            Ok(image) => image,
            Err(why) => bail!("{}: {why}", path.display()),
        };
        let size = [image.width_px(), image.height_px()];
        let first = *size_px.get_or_insert(size);
        ensure!(
            size == first,
            "{} has {} x {} pixels, {} has {} x {}: use photos of one camera in one orientation",
            path.display(),
            size[0],
            size[1],
            names[0],
            first[0],
            first[1]
        );
        let grey = image.pixels();
        pictures.push(Picture {
            name: name.clone(),
            at_s: number as f64,
            blur: blur(size[0] as usize, size[1] as usize, grey),
            grey: mean(grey),
        });
    }
    let Some(size_px) = size_px else { bail!("{} holds no photos", folder.display()) };
    Ok(Pictures { folder: folder.to_owned(), size_px, of_video: false, pictures })
}

/// Returns the mean grey level.
pub(super) fn mean(grey: &[u8]) -> f64 {
    grey.iter().map(|&value| u64::from(value)).sum::<u64>() as f64 / grey.len().max(1) as f64
}
