//! Access to the files of a SOG scene by name, in a ZIP or a folder, with a maximum size for each.

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

use zip::ZipArchive;

use super::invalid;
use crate::format::{Format, FormatError, limit};

/// Name of the file that lists the other files.
pub(in crate::format) const META: &str = "meta.json";

/// Location of the files of a scene.
pub(in crate::format) enum Files<'a> {
    /// ZIP in memory. `prefix` is the folder within it that holds the scene, with its slash.
    Zip { archive: Box<ZipArchive<Cursor<&'a [u8]>>>, prefix: String, bytes: usize },
    /// Folder on the disk.
    Folder(PathBuf),
}

impl<'a> Files<'a> {
    /// Opens a ZIP.
    pub(in crate::format) fn zip(bytes: &'a [u8]) -> Result<Self, FormatError> {
        let archive = ZipArchive::new(Cursor::new(bytes))
            .map_err(|error| invalid("ZIP archive", error.to_string()))?;
        let prefix = archive
            .file_names()
            .filter_map(|name| Some(name.ok()?.strip_suffix(META)?.to_owned()))
            .filter(|folder| folder.is_empty() || folder.ends_with('/'))
            .min_by_key(String::len)
            .ok_or_else(|| FormatError::Unknown { what: format!("a ZIP without {META}") })?;
        Ok(Self::Zip { archive: Box::new(archive), prefix, bytes: bytes.len() })
    }

    /// Returns the stored size of all named files. [byte]
    pub(super) fn stored_bytes<'n>(&self, names: impl Iterator<Item = &'n str>) -> usize {
        match self {
            Self::Zip { bytes, .. } => *bytes,
            Self::Folder(folder) => names
                .filter_map(|name| folder.join(name).metadata().ok())
                .map(|metadata| metadata.len() as usize)
                .sum(),
        }
    }

    /// Reads a file of at most `most` bytes.
    pub(super) fn read(&mut self, name: &str, most: u64) -> Result<Vec<u8>, FormatError> {
        // A scene may only refer to files in its own folder.
        if name.is_empty() || name.contains(['/', '\\', '\0']) || name == ".." {
            return Err(invalid(META, format!("{name:?} is not a file name")));
        }
        let mut bytes = Vec::new();
        let read = match self {
            Self::Zip { archive, prefix, .. } => {
                let entry = archive
                    .by_name(&format!("{prefix}{name}"))
                    .map_err(|error| invalid(name, error.to_string()))?;
                entry.take(most + 1).read_to_end(&mut bytes)
            }
            Self::Folder(folder) => {
                let path = folder.join(name);
                let io = |cause| FormatError::Io { path: path.clone(), verb: "read", cause };
                let file = File::open(&path).map_err(io)?;
                if !file.metadata().map_err(io)?.is_file() {
                    return Err(invalid(name, "not a regular file"));
                }
                file.take(most + 1).read_to_end(&mut bytes)
            }
        };
        read.map_err(|error| invalid(name, error.to_string()))?;
        limit::at_most(Format::Sog, "the size of a part, in bytes,", bytes.len() as u64, most)?;
        Ok(bytes)
    }
}

impl From<&Path> for Files<'_> {
    /// Uses the folder itself, or the folder of a `meta.json`.
    fn from(path: &Path) -> Self {
        if path.is_dir() {
            return Self::Folder(path.to_owned());
        }
        Self::Folder(path.parent().unwrap_or(Path::new("")).to_owned())
    }
}
