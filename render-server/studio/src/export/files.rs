//! The folder of a data set: under another name until it is whole, so that what is there is whole.

use std::fs;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

/// A folder that is being written.
#[derive(Debug)]
pub(super) struct Folder {
    /// Its name once it is whole.
    target: PathBuf,
    part: PathBuf,
}

impl Folder {
    /// Begins a folder that will be called `target`.
    ///
    /// # Errors
    /// If something is there, or an interrupted export is.
    pub(super) fn begin(target: &Path) -> Result<Self> {
        ensure!(
            !target.exists(),
            "{} is there already; nothing is overwritten: give another folder, or delete it",
            target.display()
        );
        let name =
            target.file_name().with_context(|| format!("{} names no folder", target.display()))?;
        let mut part = name.to_owned();
        part.push(".part");
        let part = target.with_file_name(part);
        ensure!(
            !part.exists(),
            "{} is there: an export that was interrupted, or is under way; delete it to begin again",
            part.display()
        );
        fs::create_dir_all(&part).with_context(|| format!("cannot make {}", part.display()))?;
        Ok(Self { target: target.to_owned(), part })
    }

    /// Returns where a file of it is written, and makes the folders above.
    pub(super) fn at(&self, path: &str) -> Result<PathBuf> {
        let path = self.part.join(path);
        if let Some(above) = path.parent() {
            fs::create_dir_all(above)
                .with_context(|| format!("cannot make {}", above.display()))?;
        }
        Ok(path)
    }

    /// Gives it its name.
    pub(super) fn finish(&self) -> Result<()> {
        fs::rename(&self.part, &self.target).with_context(|| {
            format!("cannot rename {} to {}", self.part.display(), self.target.display())
        })
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Whatever ended it: half a data set is none. It is gone where it was finished.
        let _ = fs::remove_dir_all(&self.part);
    }
}

/// Writes an image of 8 bits a channel as PNG, H x W x 3, sRGB.
pub(super) fn write_rgb(path: &Path, rgb: &[u8], (width, height): (u32, u32)) -> Result<()> {
    write_png(path, rgb, (width, height), ExtendedColorType::Rgb8)
}

/// Writes depth as 16-bit PNG, so many units a metre; what is beyond its range is 0, no return. Millimetres in.
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

/// `image` takes 16-bit samples in this computer's order.
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
    fn a_folder_is_there_when_it_is_whole() {
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
    fn depth_beyond_the_range_of_its_png_is_no_return() {
        let above = tempfile::tempdir().unwrap();
        let path = above.path().join("depth.png");
        write_depth(&path, &[0, 1000, 13_107, 13_108, 65_535, 7], (3, 2), 5).unwrap();
        let read = image::open(&path).unwrap().into_luma16();
        assert_eq!(read.into_raw(), [0, 5000, 65_535, 0, 0, 35]);
    }
}
