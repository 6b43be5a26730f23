//! Cache of baked obstacles, by a hash of their inputs.
//!
//! A file's name is the hash of the splats' geometry and of the bake's settings, so a changed scene or setting
//! gives another file. A file begins with a checksum: if it does not match, or the file cannot be parsed, the
//! obstacles are baked again, and the file is replaced. Files are written to a temporary name, then renamed.
//! The least recently used ones are deleted when the folder exceeds [`MAX_BYTES`].

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use ring::digest::{Context, SHA256, SHA256_OUTPUT_LEN};
use vizflyt_arena::{BakeSpec, DistanceField};
use vizflyt_splat::Splats;

use super::super::seen::Seen;

/// Folder of baked obstacles.
#[derive(Clone, Debug)]
pub struct BakeCache {
    folder: PathBuf,
}

/// Hash of a bake's inputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BakeKey([u8; SHA256_OUTPUT_LEN]);

/// Cache entry of a key.
#[derive(Debug)]
pub(super) enum CachedField {
    Field(DistanceField),
    Nothing,
    /// Why the file is invalid.
    Broken(String),
}

impl BakeKey {
    /// Returns the key of a bake.
    pub fn of(splats: &Splats, spec: &BakeSpec, seen: Option<&Seen>) -> Self {
        let mut hash = Context::new(&SHA256);
        hash.update(BAKER);
        let BakeSpec { grid, min_opacity, floor_z_m, min_splats_per_m3 } = spec;
        let numbers = [grid.min_m.x, grid.min_m.y, grid.min_m.z, grid.voxel_m, *floor_z_m];
        for number in numbers {
            hash.update(&number.to_le_bytes());
        }
        for n in grid.size {
            hash.update(&(n as u64).to_le_bytes());
        }
        for number in [min_opacity, min_splats_per_m3] {
            hash.update(&number.to_le_bytes());
        }
        if let Some(Seen { space, place }) = seen {
            hash.update(&space.to_bytes());
            let numbers = place.rotation.to_array().into_iter().chain([place.metres_per_unit]);
            for number in numbers.chain(place.origin_m.to_array()) {
                hash.update(&number.to_le_bytes());
            }
        }
        // Hashes a block of splats at a time: a call for each splat would cost more than the hash.
        let mut block = Vec::with_capacity(SPLATS_AT_ONCE * SPLAT_BYTES);
        for first in (0..splats.len()).step_by(SPLATS_AT_ONCE) {
            block.clear();
            for k in first..splats.len().min(first + SPLATS_AT_ONCE) {
                let (mean, scale) = (splats.means_m[k].to_array(), splats.scales_m[k].to_array());
                let rotation = splats.rotations[k].to_array();
                let numbers = mean.iter().chain(&scale).chain(&rotation).copied();
                let numbers = numbers.chain([splats.opacities[k]]);
                for number in numbers {
                    block.extend_from_slice(&number.to_le_bytes());
                }
            }
            hash.update(&block);
        }
        Self(digest(hash))
    }

    fn name(&self) -> String {
        vizflyt_trust::hex(&self.0) + "." + EXTENSION
    }
}

impl BakeCache {
    /// Stores files in a folder, which is created at the first write.
    pub fn at(folder: impl Into<PathBuf>) -> Self {
        Self { folder: folder.into() }
    }

    /// Stores files in `$XDG_CACHE_HOME/vizflyt/obstacles`, or under `~/.cache`; `None` if neither is known.
    pub fn of_user() -> Option<Self> {
        let path =
            |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let caches = path("XDG_CACHE_HOME").or_else(|| Some(path("HOME")?.join(".cache")))?;
        Some(Self::at(caches.join("vizflyt/obstacles")))
    }

    /// Returns the path of a bake, whether or not it exists.
    pub fn path(&self, key: &BakeKey) -> PathBuf {
        self.folder.join(key.name())
    }

    /// Deletes the bake of a scene, so that it is baked again.
    ///
    /// # Errors
    /// An existing file cannot be removed.
    pub fn forget(&self, splats: &Splats, spec: &BakeSpec, seen: Option<&Seen>) -> io::Result<()> {
        match fs::remove_file(self.path(&BakeKey::of(splats, spec, seen))) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    pub(super) fn read(&self, key: &BakeKey) -> CachedField {
        let path = self.path(key);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return CachedField::Nothing,
            Err(error) => return CachedField::Broken(error.to_string()),
        };
        match parse(&bytes) {
            Ok(field) => {
                // Marks the file as recently used; if this fails, it may be deleted earlier.
                let _ = File::open(&path).and_then(|file| file.set_modified(SystemTime::now()));
                CachedField::Field(field)
            }
            Err(why) => CachedField::Broken(why),
        }
    }

    /// Stores a bake; returns its path.
    pub(super) fn write(&self, key: &BakeKey, field: &DistanceField) -> io::Result<PathBuf> {
        fs::create_dir_all(&self.folder)?;
        let path = self.path(key);
        let aside = path.with_extension(format!("{}.part", std::process::id()));
        let (header, codes, unseen) = field.as_bytes();
        let written = File::create(&aside).and_then(|mut file| {
            file.write_all(&checksum(&[&header, codes, unseen]))?;
            file.write_all(&header)?;
            file.write_all(codes)?;
            file.write_all(unseen)?;
            fs::rename(&aside, &path)
        });
        if written.is_err() {
            let _ = fs::remove_file(&aside);
        }
        written?;
        self.shrink(&path);
        Ok(path)
    }

    /// Deletes the least recently used files above the limit, except `newest`.
    fn shrink(&self, newest: &Path) {
        let Ok(entries) = fs::read_dir(&self.folder) else { return };
        let mut files: Vec<_> = entries
            .filter_map(|entry| {
                let (path, about) = (entry.as_ref().ok()?.path(), entry.ok()?.metadata().ok()?);
                let ours = path.extension().is_some_and(|extension| extension == EXTENSION);
                ours.then_some((about.modified().ok()?, about.len(), path))
            })
            .collect();
        files.sort();
        let mut bytes: u64 = files.iter().map(|(_, len, _)| len).sum();
        for (_, len, path) in files {
            if bytes <= MAX_BYTES {
                break;
            }
            if path != newest && fs::remove_file(&path).is_ok() {
                bytes -= len;
            }
        }
    }
}

/// Parses a file of the cache: a checksum, then the field.
///
/// # Errors
/// Why it is invalid.
pub fn parse(bytes: &[u8]) -> Result<DistanceField, String> {
    let (sum, field) = bytes
        .split_first_chunk::<SHA256_OUTPUT_LEN>()
        .ok_or_else(|| format!("it has only {} bytes", bytes.len()))?;
    if checksum(&[field]) != *sum {
        return Err("its checksum does not match".into());
    }
    DistanceField::from_bytes(field).map_err(|error| error.to_string())
}

fn checksum(parts: &[&[u8]]) -> [u8; SHA256_OUTPUT_LEN] {
    let mut hash = Context::new(&SHA256);
    for part in parts {
        hash.update(part);
    }
    digest(hash)
}

fn digest(hash: Context) -> [u8; SHA256_OUTPUT_LEN] {
    let mut bytes = [0; SHA256_OUTPUT_LEN];
    bytes.copy_from_slice(hash.finish().as_ref());
    bytes
}

/// Version of the baker: increase it with any change of the result for the same splats.
const BAKER: &[u8] = b"vizflyt obstacles 1";
const EXTENSION: &str = "field";
/// Splats hashed at once, and bytes per splat.
const SPLATS_AT_ONCE: usize = 4096;
const SPLAT_BYTES: usize = 44;
/// Maximum size of the folder; a forest takes 24 MB. [bytes]
const MAX_BYTES: u64 = 1 << 30;
