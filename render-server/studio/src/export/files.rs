//! Output folder of a data set. It has a temporary name until it is complete.

use std::fs;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

/// Folder that is being written.
#[derive(Debug)]
pub(super) struct Folder {
    /// Final path.
    target: PathBuf,
    part: PathBuf,
}

impl Folder {
    /// Creates the temporary folder for `target`.
    ///
    /// # Errors
    /// The target or its temporary folder exists.
    pub(super) fn begin(target: &Path) -> Result<Self> {
        ensure!(
            !target.exists(),
            "{} already exists; nothing is overwritten: give another folder, or delete it",
            target.display()
        );
        let name = target
            .file_name()
            .with_context(|| format!("{} is not the name of a folder", target.display()))?;
        let mut part = name.to_owned();
        part.push(".part");
        let part = target.with_file_name(part);
        ensure!(
            !part.exists(),
            "{} exists: an interrupted or running export; delete it to start again",
            part.display()
        );
        fs::create_dir_all(&part).with_context(|| format!("cannot make {}", part.display()))?;
        Ok(Self { target: target.to_owned(), part })
    }

    /// Returns the temporary path of a file, and creates its parent folders.
    pub(super) fn at(&self, path: &str) -> Result<PathBuf> {
        let path = self.part.join(path);
        if let Some(above) = path.parent() {
            fs::create_dir_all(above)
                .with_context(|| format!("cannot make {}", above.display()))?;
        }
        Ok(path)
    }

    /// Renames the folder to its final path.
    pub(super) fn finish(&self) -> Result<()> {
        fs::rename(&self.part, &self.target).with_context(|| {
            format!("cannot rename {} to {}", self.part.display(), self.target.display())
        })
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Removes an incomplete data set. After `finish`, the temporary folder no longer exists.
        let _ = fs::remove_dir_all(&self.part);
    }
}

/// Writes an image of H x W x 3 bytes, sRGB, as PNG.
pub(super) fn write_rgb(path: &Path, rgb: &[u8], (width, height): (u32, u32)) -> Result<()> {
    write_png(path, rgb, (width, height), ExtendedColorType::Rgb8)
}

/// Writes depth in millimetres as 16-bit PNG with this number of units per millimetre. Depth beyond its range becomes 0
/// (no depth).
pub(super) fn write_depth(
    path: &Path,
    depth_mm: &[u16],
    size: (u32, u32),
    units_per_mm: u16,
) -> Result<()> {
    let scaled = |mm: &u16| mm.checked_mul(units_per_mm).unwrap_or(0).to_ne_bytes();
    let bytes: Vec<u8> = depth_mm.iter().flat_map(scaled).collect();
    write_png(path, &bytes, size, ExtendedColorType::L16)
}

/// Writes a PNG. `image` expects 16-bit samples in native byte order.
fn write_png(
    path: &Path,
    bytes: &[u8],
    (width, height): (u32, u32),
    color: ExtendedColorType,
) -> Result<()> {
    let context = super::context(path);
    let file = BufWriter::new(fs::File::create(path).with_context(&context)?);
    PngEncoder::new_with_quality(file, CompressionType::Fast, FilterType::Adaptive)
        .write_image(bytes, width, height, color)
        .with_context(&context)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_appears_when_it_is_complete() {
        let above = tempfile::tempdir().unwrap();
        let target = above.path().join("set");
        let folder = Folder::begin(&target).unwrap();
        fs::write(folder.at("a/b.txt").unwrap(), "x").unwrap();
        assert!(Folder::begin(&target).unwrap_err().to_string().contains("interrupted"));
        drop(folder);
        assert!(!above.path().join("set.part").exists() && !target.exists());
        let folder = Folder::begin(&target).unwrap();
        fs::write(folder.at("a/b.txt").unwrap(), "x").unwrap();
        folder.finish().unwrap();
        drop(folder);
        assert_eq!(fs::read(target.join("a/b.txt")).unwrap(), b"x");
        assert!(Folder::begin(&target).unwrap_err().to_string().contains("nothing is overwritten"));
    }

    #[test]
    fn depth_beyond_the_range_of_the_png_becomes_zero() {
        let above = tempfile::tempdir().unwrap();
        let path = above.path().join("depth.png");
        write_depth(&path, &[0, 1000, 13_107, 13_108, 65_535, 7], (3, 2), 5).unwrap();
        let read = image::open(&path).unwrap().into_luma16();
        assert_eq!(read.into_raw(), [0, 5000, 65_535, 0, 0, 35]);
    }
}
