//! Memory that two processes share and neither can resize: memfd_create(2), sealed with fcntl(2) `F_ADD_SEALS`.

#![allow(unsafe_code, reason = "maps memory; it is sealed, so that no access can fault")]

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};

use memmap2::{Mmap, MmapMut, MmapOptions, MmapRaw};
use nix::fcntl::{FcntlArg, FdFlag, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};

/// Memory that this process writes. A process that receives the descriptor can only read it.
#[derive(Debug)]
pub(super) struct WrittenMemory {
    file: File,
    map: MmapMut,
}

impl WrittenMemory {
    /// Creates `len` bytes of zeros. [bytes]
    pub(super) fn new(len: usize) -> io::Result<Self> {
        let file = memory_file(c"vizflyt-observation", len)?;
        // SAFETY: no other process has the file yet, and it is sealed against shrinking below, before it is shared.
        let map = unsafe { MmapMut::map_mut(&file) }?;
        // The existing mapping stays writable; new mappings cannot be.
        seal(&file, RESIZING | SealFlag::F_SEAL_FUTURE_WRITE)?;
        Ok(Self { file, map })
    }

    pub(super) fn len(&self) -> usize {
        self.map.len()
    }

    pub(super) fn bytes(&self) -> &[u8] {
        &self.map
    }

    pub(super) fn bytes_mut(&mut self) -> &mut [u8] {
        &mut self.map
    }
}

impl AsFd for WrittenMemory {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

/// Memory that both processes write, accessed only by atomic operations.
#[derive(Debug)]
pub(super) struct AtomicMemory {
    file: File,
    map: MmapRaw,
}

impl AtomicMemory {
    /// Creates one `T`, all zeros.
    pub(super) fn new<T>() -> io::Result<Self> {
        let file = memory_file(c"vizflyt-board", size_of::<T>())?;
        seal(&file, RESIZING)?;
        Ok(Self { map: MmapRaw::map_raw(&file)?, file })
    }

    /// Maps memory that the other side created.
    ///
    /// # Errors
    /// If it is not sealed, or too small for a `T`.
    pub(super) fn open<T>(descriptor: OwnedFd) -> io::Result<Self> {
        let file = sealed_file(descriptor, size_of::<T>())?;
        Ok(Self { map: MmapRaw::map_raw(&file)?, file })
    }

    /// Returns the mapped `T`.
    ///
    /// # Safety
    /// `T` must consist of atomics only, and must be the type given to [`Self::new`] or [`Self::open`].
    pub(super) unsafe fn get<T>(&self) -> &T {
        assert!(self.map.len() >= size_of::<T>());
        // SAFETY: a mapping begins on a page, is long enough, cannot shrink, and any bits are valid for atomics. The
        // other process changes them only by atomic operations; otherwise it harms only itself.
        unsafe { &*self.map.as_ptr().cast::<T>() }
    }
}

impl AsFd for AtomicMemory {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

/// Maps memory of the other side, read-only.
///
/// # Errors
/// If it is not sealed against shrinking: reading a truncated part would kill this process.
pub(super) fn map_read_only(descriptor: OwnedFd) -> io::Result<Mmap> {
    let file = sealed_file(descriptor, 1)?;
    // SAFETY: the file cannot shrink, and the runtime does not write observations that a plugin has borrowed.
    unsafe { MmapOptions::new().map(&file) }
}

/// Takes over an inherited descriptor, and closes it for child processes.
///
/// # Errors
/// If it is not open.
pub(super) fn take_inherited(descriptor: RawFd) -> io::Result<OwnedFd> {
    // SAFETY: a query for a number; the kernel returns an error if it is not open.
    if descriptor < 0 || unsafe { nix::libc::fcntl(descriptor, nix::libc::F_GETFD) } < 0 {
        return Err(io::Error::from_raw_os_error(nix::libc::EBADF));
    }
    // SAFETY: it is open, and the command line gave it to this process only.
    let owned = unsafe { OwnedFd::from_raw_fd(descriptor) };
    fcntl(&owned, FcntlArg::F_SETFD(FdFlag::FD_CLOEXEC))?;
    Ok(owned)
}

/// Lets a child process inherit a descriptor under the same number. Call it between fork and exec.
///
/// # Errors
/// Errors of the system.
pub(super) fn let_inherit(descriptor: BorrowedFd<'_>) -> io::Result<()> {
    fcntl(descriptor, FcntlArg::F_SETFD(FdFlag::empty()))?;
    Ok(())
}

const RESIZING: SealFlag =
    SealFlag::F_SEAL_SHRINK.union(SealFlag::F_SEAL_GROW).union(SealFlag::F_SEAL_SEAL);

fn memory_file(name: &std::ffi::CStr, len: usize) -> io::Result<File> {
    let file = File::from(memfd_create(name, MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING)?);
    file.set_len(len as u64)?;
    Ok(file)
}

fn seal(file: &File, seals: SealFlag) -> io::Result<()> {
    fcntl(file, FcntlArg::F_ADD_SEALS(seals))?;
    Ok(())
}

fn sealed_file(descriptor: OwnedFd, least_len: usize) -> io::Result<File> {
    let seals = SealFlag::from_bits_truncate(fcntl(&descriptor, FcntlArg::F_GET_SEALS)?);
    let file = File::from(descriptor);
    if !seals.contains(SealFlag::F_SEAL_SHRINK) || file.metadata()?.len() < least_len as u64 {
        let number = file.as_raw_fd();
        let text =
            format!("descriptor {number} is not sealed memory of at least {least_len} bytes");
        return Err(io::Error::new(io::ErrorKind::InvalidData, text));
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::FileExt;

    #[test]
    fn reader_can_neither_resize_nor_write() {
        let mut memory = WrittenMemory::new(5000).unwrap();
        memory.bytes_mut()[4999] = 7;
        let theirs = memory.as_fd().try_clone_to_owned().unwrap();
        let file = File::from(theirs.try_clone().unwrap());
        for len in [0, 4999, 5001, 1 << 30] {
            assert!(file.set_len(len).is_err(), "{len}");
        }
        assert!(file.write_at(b"x", 0).is_err());
        // SAFETY: expected to fail; no other code accesses the mapping.
        assert!(unsafe { MmapMut::map_mut(&file) }.is_err());
        let map = map_read_only(theirs).unwrap();
        assert_eq!(map[4999], 7);
        assert!(map.make_mut().is_err(), "must stay read-only");
        memory.bytes_mut()[0] = 9;
        assert_eq!(memory.bytes()[..1], [9]);
    }

    #[test]
    fn rejects_memory_that_could_shrink() {
        let file = memory_file(c"open", 100).unwrap();
        let error = map_read_only(file.into()).unwrap_err();
        assert!(error.to_string().contains("not sealed memory"), "{error}");
        let small = AtomicMemory::new::<u64>().unwrap();
        let theirs = small.as_fd().try_clone_to_owned().unwrap();
        assert!(AtomicMemory::open::<[u64; 1000]>(theirs).is_err());
    }
}
