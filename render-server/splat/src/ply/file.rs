//! Bytes of a file, without a second copy of them in memory.

use std::fs::File;
use std::io;
use std::path::Path;

use memmap2::Mmap;

/// Maps a file for reading.
pub(super) fn map(path: &Path) -> io::Result<Mmap> {
    let file = File::open(path)?;
    if !file.metadata()?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a regular file"));
    }
    shared_memory::map(&file)
}

/// The one call that the operating system cannot make safe.
mod shared_memory {
    use super::{File, Mmap, io};

    pub(super) fn map(file: &File) -> io::Result<Mmap> {
        // SAFETY: the mapping is private to this process and read-only. Another process that
        // rewrites the scene while it loads could change bytes under us: every number is read
        // once, by value, and checked after it was read, so the worst is a wrong splat; one that
        // truncates it ends this process with a bus error, as for every program that maps files.
        unsafe { Mmap::map(file) }
    }
}
