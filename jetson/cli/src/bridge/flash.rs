//! Emulated flash of a chip, in a file or in memory: erased bytes are 0xFF, writing clears bits.

use std::fs;
use std::io;
use std::path::PathBuf;

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

/// Flash of the emulated bridge.
pub(crate) struct FileFlash {
    bytes: Vec<u8>,
    path: Option<PathBuf>,
}

/// Address out of range, or the file could not be written.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FlashError;

impl NorFlashError for FlashError {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

const SECTOR: usize = 4096;
const SIZE: usize = 2 * SECTOR;

impl FileFlash {
    /// Opens the flash; a missing file is an erased flash.
    pub(crate) fn open(path: Option<PathBuf>) -> io::Result<Self> {
        let mut bytes = match &path {
            Some(path) if path.exists() => fs::read(path)?,
            _ => Vec::new(),
        };
        bytes.resize(SIZE, 0xFF);
        Ok(Self { bytes, path })
    }

    /// Returns an erased spare half in memory.
    pub(crate) fn spare(size: usize) -> Self {
        Self { bytes: vec![0xFF; size], path: None }
    }

    fn place(&mut self, from: usize, len: usize) -> Result<&mut [u8], FlashError> {
        self.bytes.get_mut(from..from + len).ok_or(FlashError)
    }

    fn keep(&self) -> Result<(), FlashError> {
        match &self.path {
            Some(path) => fs::write(path, &self.bytes).map_err(|error| {
                tracing::error!("bridge: cannot write {}: {error}", path.display());
                FlashError
            }),
            None => Ok(()),
        }
    }
}

impl ErrorType for FileFlash {
    type Error = FlashError;
}

impl ReadNorFlash for FileFlash {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
        bytes.copy_from_slice(self.place(offset as usize, bytes.len())?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl NorFlash for FileFlash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashError> {
        let len = to.checked_sub(from).ok_or(FlashError)? as usize;
        self.place(from as usize, len)?.fill(0xFF);
        self.keep()
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
        for (cell, byte) in self.place(offset as usize, bytes.len())?.iter_mut().zip(bytes) {
            *cell &= byte;
        }
        self.keep()
    }
}
