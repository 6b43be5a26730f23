//! Reading and writing of scene files, as [`Splats`].
//!
//! [`read`] detects the format by content, then by name. It maps the file and passes the bytes to
//! the module of the format, which checks every size against the length of the file before it
//! allocates, and decodes in parallel into a [`Loaded`]. The result is activated and in the axes of
//! the trainer's PLY; invalid splats are dropped and counted. [`write`] selects the format by file
//! name. Server, command line and benches call these functions once per scene.
//!
//! | format | names | read | written | harmonics | positions |
//! |---|---|---|---|---|---|
//! | [`Format::Ply`] | `.ply` | INRIA, splatfacto, brush, PostShot; binary and ascii | INRIA's layout | 0-3 | f32 |
//! | [`Format::CompressedPly`] | `.compressed.ply` | with and without colour bounds and harmonics | with | 0-3 | 11-10-11 bits in blocks of 256 |
//! | [`Format::Splat`] | `.splat` | all | all | 0 | f32 |
//! | [`Format::Spz`] | `.spz` | versions 1-4 | version 3 | 0-3 (4 reduced) | 24 bits, 1/4096 m |
//! | [`Format::Sog`] | `.sog`, `meta.json` or its folder; `lod-meta.json` or its folder | versions 1, 2; streamed, one level | version 2 | 0-3 | 16 bits of the logarithm |
//! | [`Format::Ksplat`] | `.ksplat` | levels 0-2 | level 1 | 0-2 | f32, or 16 bits in 5 m |
//! | [`Format::Gltf`] | `.glb`, `.gltf` | `KHR_gaussian_splatting`, not compressed | `.glb` | 0-3 | f32 |
//!
//! Hostile files cost at most a constant plus a multiple of their own size (`limit`), in time and
//! memory. Budget: 1 M splats per second on two cores, memory within twice the decoded size.

mod activate;
mod block;
mod bytes;
mod error;
mod file;
mod gltf;
mod ksplat;
mod limit;
mod order;
pub mod ply;
mod progress;
mod quantise;
mod sog;
mod splat;
mod spz;

use std::fmt;
use std::path::Path;

pub use block::DropCounts;
pub use error::FormatError;
pub use progress::{Progress, Report};
pub use sog::assemble_streamed;

use crate::Splats;
use progress::Meter;

/// Scene that was read from a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Loaded {
    /// Detected file format.
    pub format: Format,
    /// Valid splats, in file order.
    pub splats: Splats,
    /// Number of invalid splats that were dropped, by reason.
    pub dropped: DropCounts,
    /// Names of per-splat properties that were ignored, in file order.
    pub skipped_properties: Vec<String>,
    /// Names of PLY elements without splats that were ignored, in file order.
    pub skipped_elements: Vec<String>,
}

impl Loaded {
    /// Returns the scene, or an error if it has no splats.
    fn whole(
        format: Format,
        declared: usize,
        splats: Splats,
        dropped: DropCounts,
    ) -> Result<Self, FormatError> {
        if splats.is_empty() {
            return Err(FormatError::Empty { format, declared, dropped: dropped.total() });
        }
        Ok(Self {
            format,
            splats,
            dropped,
            skipped_properties: Vec::new(),
            skipped_elements: Vec::new(),
        })
    }
}

/// Format of a scene file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Format {
    /// PLY as trainers write it.
    Ply,
    /// SuperSplat's compressed PLY.
    CompressedPly,
    /// Format of antimatter15's viewer, 32 bytes per splat.
    Splat,
    /// Niantic's SPZ.
    Spz,
    /// PlayCanvas's textures (SOG).
    Sog,
    /// Format of the viewer GaussianSplats3D.
    Ksplat,
    /// Khronos's glTF with `KHR_gaussian_splatting`.
    Gltf,
}

impl Format {
    /// All formats, the simplest first.
    pub const ALL: [Self; 7] = [
        Self::Ply,
        Self::CompressedPly,
        Self::Splat,
        Self::Spz,
        Self::Sog,
        Self::Ksplat,
        Self::Gltf,
    ];

    /// Returns the common name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "PLY",
            Self::CompressedPly => "compressed PLY",
            Self::Splat => ".splat",
            Self::Spz => "SPZ",
            Self::Sog => "SOG",
            Self::Ksplat => ".ksplat",
            Self::Gltf => "glTF",
        }
    }

    /// Returns the file extension, without the leading dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::CompressedPly => "compressed.ply",
            Self::Splat => "splat",
            Self::Spz => "spz",
            Self::Sog => "sog",
            Self::Ksplat => "ksplat",
            Self::Gltf => "glb",
        }
    }

    /// Returns the highest degree of harmonics that the format stores.
    pub fn max_sh_degree(self) -> u8 {
        match self {
            Self::Splat => 0,
            Self::Ksplat => ksplat::MAX_SH_DEGREE,
            Self::Ply | Self::CompressedPly | Self::Spz | Self::Sog | Self::Gltf => 3,
        }
    }

    /// Returns whether the format stores if a scene was trained with anti-aliasing.
    pub fn keeps_antialiased(self) -> bool {
        !matches!(self, Self::Splat | Self::Ksplat)
    }

    /// Returns the variants that can be written, the default first: versions of SPZ (2 is coarser,
    /// few readers support 4) and SOG, compression levels of `.ksplat`. Formats without variants
    /// have only 0.
    pub fn variants(self) -> &'static [u32] {
        match self {
            Self::Ply | Self::CompressedPly | Self::Splat | Self::Gltf => &[0],
            Self::Spz => &[3, 2, 4],
            Self::Sog => &[2],
            Self::Ksplat => &[1, 0, 2],
        }
    }

    /// Returns the format that a file name indicates.
    pub fn of_name(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.to_ascii_lowercase();
        if name == sog::META || name == sog::LOD_META {
            return Some(Self::Sog);
        }
        if is_gltf_text(path) {
            return Some(Self::Gltf);
        }
        // The longest matching extension wins: `.compressed.ply` also ends in `.ply`.
        Self::ALL
            .into_iter()
            .filter(|format| {
                let stem = name.strip_suffix(format.extension());
                stem.is_some_and(|stem| stem.ends_with('.'))
            })
            .max_by_key(|format| format.extension().len())
    }

    /// Returns the format that the first bytes of a file indicate. `.splat` has no magic number.
    pub fn of_content(bytes: &[u8]) -> Option<Self> {
        if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
            // The header determines which of the two PLY formats it is.
            Some(Self::Ply)
        } else if bytes.starts_with(&spz::GZIP_MAGIC)
            || bytes.starts_with(&spz::MAGIC.to_le_bytes())
        {
            Some(Self::Spz)
        } else if bytes.starts_with(b"PK\x03\x04") {
            Some(Self::Sog)
        } else if bytes.starts_with(gltf::MAGIC) {
            Some(Self::Gltf)
        } else if ksplat::is_ksplat(bytes) {
            Some(Self::Ksplat)
        } else {
            None
        }
    }

    /// Returns all names with their extensions, for error messages.
    fn list() -> String {
        let each = Self::ALL.map(|format| match format {
            Self::Splat | Self::Ksplat => format.name().to_owned(),
            Self::Sog => "SOG (.sog, or the folder of its meta.json)".into(),
            _ => format!("{} (.{})", format.name(), format.extension()),
        });
        each.join(", ")
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Reads a scene file of any supported format, which is detected by content, then by name. A folder
/// or a `meta.json` is read as SOG. Of a `lod-meta.json`, the finest level is read.
///
/// # Errors
/// [`FormatError::Io`] with the path; [`FormatError::Unknown`] with the list of supported formats;
/// otherwise the defect that makes the file invalid in its format.
pub fn read(path: impl AsRef<Path>) -> Result<Loaded, FormatError> {
    read_metered(path.as_ref(), 0, &Meter::SILENT)
}

/// Reads a level of a streamed scene as [`read()`] does; 0 is the finest level.
///
/// # Errors
/// As [`read()`]; [`FormatError::Unsupported`] if the scene has no levels.
pub fn read_level(path: impl AsRef<Path>, level: u32) -> Result<Loaded, FormatError> {
    read_metered(path.as_ref(), level, &Meter::SILENT)
}

/// Reads a scene as [`read()`] does, and reports progress to `report`. Large scenes take more than
/// a second to load.
///
/// # Errors
/// As [`read()`].
pub fn read_with_progress(path: impl AsRef<Path>, report: Report) -> Result<Loaded, FormatError> {
    let meter = Meter::new(report);
    let loaded = read_metered(path.as_ref(), 0, &meter)?;
    meter.finish();
    Ok(loaded)
}

/// Reads a scene of any format in pieces. The finest level of a streamed scene is read chunk by
/// chunk, so that only one chunk is in memory; its environment comes last. Any other scene is one
/// piece.
///
/// # Errors
/// As [`read()`], and errors of `visit`.
pub fn read_in_chunks<E: From<FormatError>>(
    path: impl AsRef<Path>,
    mut visit: impl FnMut(Splats) -> Result<(), E>,
) -> Result<(), E> {
    let path = path.as_ref();
    match streamed_folder(path) {
        Some(folder) => {
            let open = |name: &str| open_chunk(folder, name);
            sog::each_chunk(&read_tree(folder)?, 0, open, |chunk, _| visit(chunk.splats))
        }
        None => visit(read(path)?.splats),
    }
}

/// Reads the bytes of a scene file. `named` is the format if the content has no magic number.
///
/// # Errors
/// As [`read()`], without the path.
pub fn parse(bytes: &[u8], named: Format) -> Result<Loaded, FormatError> {
    decode(bytes, Format::of_content(bytes).unwrap_or(named), None, &Meter::SILENT)
}

/// Writes a scene in the format that the file name indicates. A `meta.json` becomes a SOG scene of
/// single files in the same folder. Each file is written next to its destination and then renamed,
/// so that readers never see a partial file.
///
/// # Errors
/// [`FormatError::Unknown`] if the name indicates no known format; [`FormatError::Io`] with the
/// path.
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn write(path: impl AsRef<Path>, splats: &Splats) -> Result<(), FormatError> {
    let path = path.as_ref();
    let is_tree = path.file_name().is_some_and(|name| name == sog::LOD_META);
    let format = Format::of_name(path).filter(|_| !is_tree && !is_gltf_text(path));
    let format = format.ok_or_else(|| FormatError::Unknown {
        what: format!("{} has no extension of a writable format", path.display()),
    })?;
    let place = |path: &Path, bytes: &[u8]| {
        file::replace(path, bytes).map_err(|cause| FormatError::Io {
            path: path.to_owned(),
            verb: "write",
            cause,
        })
    };
    if path.file_name().is_some_and(|name| name == sog::META) {
        return sog::parts(splats)?
            .iter()
            .try_for_each(|(name, bytes)| place(&path.with_file_name(name), bytes));
    }
    place(path, &encode(format, splats)?)
}

/// Returns the bytes that [`write()`] writes: the first variant of the format. Harmonics beyond
/// [`Format::max_sh_degree`] are dropped. Packed formats change the order of the splats.
///
/// # Errors
/// [`FormatError::Invalid`] if the format cannot store the scene.
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn encode(format: Format, splats: &Splats) -> Result<Vec<u8>, FormatError> {
    encode_variant(format, format.variants()[0], splats)
}

/// Encodes a scene as [`encode`] does, in one of the format's [variants](Format::variants).
///
/// # Errors
/// [`FormatError::Unsupported`] if the variant cannot be written; otherwise as [`encode`].
///
/// # Panics
/// If the vectors of `splats` differ in length.
pub fn encode_variant(
    format: Format,
    variant: u32,
    splats: &Splats,
) -> Result<Vec<u8>, FormatError> {
    if !format.variants().contains(&variant) {
        return Err(FormatError::Unsupported {
            format,
            what: format!("writing variant {variant}"),
            advice: "ask for one of `Format::variants`",
        });
    }
    Ok(match format {
        Format::Ply => ply::encode(splats),
        Format::CompressedPly => ply::encode_compressed(splats),
        Format::Splat => splat::encode(splats),
        Format::Spz => spz::encode(splats, variant),
        Format::Sog => sog::encode(splats)?,
        Format::Ksplat => ksplat::encode(splats, variant),
        Format::Gltf => gltf::encode(splats),
    })
}

fn read_metered(path: &Path, level: u32, meter: &Meter) -> Result<Loaded, FormatError> {
    let named = Format::of_name(path);
    if let Some(folder) = streamed_folder(path) {
        return read_streamed(folder, level);
    }
    if level > 0 {
        return Err(FormatError::Unsupported {
            format: named.unwrap_or(Format::Ply),
            what: format!("level {level} of a scene without levels"),
            advice: "only streamed scenes, with a lod-meta.json, have levels",
        });
    }
    let is_meta = path.file_name().is_some_and(|name| name == sog::META);
    if is_meta || path.join(sog::META).is_file() {
        return sog::decode(sog::Files::from(path), meter);
    }
    let io = |cause| FormatError::Io { path: path.to_owned(), verb: "read", cause };
    let bytes = file::map(path).map_err(io)?;
    if let Some(what) = no_scene(&bytes) {
        return Err(FormatError::Unknown { what: format!("{} is {what}", path.display()) });
    }
    let format = Format::of_content(&bytes).or(named).ok_or_else(|| {
        let start = String::from_utf8_lossy(&bytes[..bytes.len().min(8)]).into_owned();
        FormatError::Unknown {
            what: format!("{} is not a scene file: it starts with {start:?}", path.display()),
        }
    })?;
    decode(&bytes, format, path.parent(), meter)
}

/// Reads a level of the streamed scene in `folder`.
fn read_streamed(folder: &Path, level: u32) -> Result<Loaded, FormatError> {
    sog::assemble_streamed(&read_tree(folder)?, level, |name| open_chunk(folder, name))
}

/// Maps the index (`lod-meta.json`) of the streamed scene in `folder`.
fn read_tree(folder: &Path) -> Result<memmap2::Mmap, FormatError> {
    let path = folder.join(sog::LOD_META);
    file::map(&path).map_err(|cause| FormatError::Io { path, verb: "read", cause })
}

/// Reads a chunk of the streamed scene in `folder`.
fn open_chunk(folder: &Path, name: &str) -> Result<Loaded, FormatError> {
    // A scene may only refer to files in its own folder.
    let inside = name.split('/').all(|part| !matches!(part, "" | "." | ".."));
    if !inside || name.contains(['\\', ':', '\0']) {
        return Err(FormatError::Invalid {
            format: Format::Sog,
            place: sog::LOD_META.into(),
            reason: format!("{name:?} is not a file in the scene's folder"),
        });
    }
    let chunk = folder.join(name);
    if chunk.file_name().is_some_and(|name| name == sog::META) {
        return sog::decode(sog::Files::from(chunk.as_path()), &Meter::SILENT);
    }
    let io = |cause| FormatError::Io { path: chunk.clone(), verb: "read", cause };
    sog::decode(sog::Files::zip(&file::map(&chunk).map_err(io)?)?, &Meter::SILENT)
}

/// Returns the folder of a streamed scene, if `path` is one.
fn streamed_folder(path: &Path) -> Option<&Path> {
    if path.file_name().is_some_and(|name| name == sog::LOD_META) {
        return Some(path.parent().unwrap_or(Path::new("")));
    }
    path.join(sog::LOD_META).is_file().then_some(path)
}

/// Returns a description of a file that is known not to be a scene, for example a failed download.
fn no_scene(bytes: &[u8]) -> Option<&'static str> {
    let start = bytes.trim_ascii_start();
    let is_html = |tag: &[u8]| start.get(..tag.len()).is_some_and(|s| s.eq_ignore_ascii_case(tag));
    if bytes.starts_with(b"version https://git-lfs.github.com/spec/") {
        Some("a pointer of Git LFS, not the file itself; run `git lfs pull`")
    } else if is_html(b"<!doctype html") || is_html(b"<html") {
        Some("a web page, not the file itself; download it by its direct address")
    } else if bytes.starts_with(crate::cpu::PACKED_MAGIC) {
        Some(
            "a packed scene, which is too large to load; use `scene render`, `bench render` or an arena.toml that \
             names it, or give the scene that it was packed from",
        )
    } else {
        None
    }
}

/// Returns whether a name is that of a glTF JSON file, with buffers in other files.
fn is_gltf_text(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gltf"))
}

/// Decodes a file. `folder` is its location, if known.
fn decode(
    bytes: &[u8],
    format: Format,
    folder: Option<&Path>,
    meter: &Meter,
) -> Result<Loaded, FormatError> {
    match format {
        Format::Ply | Format::CompressedPly => Ok(ply::decode(bytes, meter)?),
        Format::Splat => splat::decode(bytes, meter),
        Format::Spz => spz::decode(bytes, meter),
        Format::Sog => sog::decode(sog::Files::zip(bytes)?, meter),
        Format::Ksplat => ksplat::decode(bytes, meter),
        Format::Gltf => gltf::decode(bytes, folder, meter),
    }
}

/// # Panics
/// If the vectors of `splats` differ in length.
fn assert_whole(splats: &Splats) {
    let count = splats.len();
    assert_eq!(splats.scales_m.len(), count, "one scale per splat");
    assert_eq!(splats.rotations.len(), count, "one rotation per splat");
    assert_eq!(splats.opacities.len(), count, "one opacity per splat");
    let numbers = count * splats.sh_coefficients() * 3;
    assert_eq!(splats.sh.len(), numbers, "harmonics for every splat");
}

#[cfg(test)]
mod tests;
