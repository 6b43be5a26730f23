//! Files in and out: bytes without a second copy of them in memory, writes that are whole or not
//! there.

#![allow(unsafe_code, reason = "maps a file")]

use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;

use memmap2::Mmap;

/// Maps a file for reading.
pub(super) fn map(path: &Path) -> io::Result<Mmap> {
    // Asked before it is opened: a pipe would wait there for its writer.
    if !std::fs::metadata(path)?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file"));
    }
    let file = File::open(path)?;
    shared_memory::map(&file)
}

/// Writes a file beside its place and then renames it, so that a reader never sees half of it.
pub(super) fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(".part");
    let mut file = File::create(&partial)?;
    file.write_all(bytes)?;
    std::fs::rename(&partial, path)
}

/// The one call that the operating system cannot make safe.
mod shared_memory {
    use super::{File, Mmap, io};

    pub(in crate::format) fn map(file: &File) -> io::Result<Mmap> {
        // SAFETY: the mapping is private to this process and read-only. Another process that
        // rewrites the scene while it loads could change bytes under us: every number is read
        // once, by value, and checked after it was read, so the worst is a wrong splat; one that
        // truncates it ends this process with a bus error, as for every program that maps files.
        unsafe { Mmap::map(file) }
    }
}
