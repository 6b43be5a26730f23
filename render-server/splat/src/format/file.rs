//! File access: memory-mapped reading, and atomic writing.

#![allow(unsafe_code, reason = "maps a file")]

use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;

use memmap2::Mmap;

/// Maps a file for reading.
pub(super) fn map(path: &Path) -> io::Result<Mmap> {
    // Checked before opening: opening a pipe would block until it has a writer.
    if !std::fs::metadata(path)?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file"));
    }
    let file = File::open(path)?;
    shared_memory::map(&file)
}

/// Writes a file under a temporary name and then renames it, so that readers never see a partial
/// file.
pub(super) fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".part");
    let mut file = File::create(&partial)?;
    file.write_all(bytes)?;
    std::fs::rename(&partial, path)
}

/// Contains the only unsafe call.
mod shared_memory {
    use super::{File, Mmap, io};

    pub(in crate::format) fn map(file: &File) -> io::Result<Mmap> {
        // SAFETY: the mapping is private to this process and read-only. Another process that
        // rewrites the scene during loading can change mapped bytes. Every number is therefore read
        // once, by value, and checked after it was read, so the worst result is a wrong splat. A
        // process that truncates the file ends this process with a bus error, as in every program
        // that maps files.
        unsafe { Mmap::map(file) }
    }
}
