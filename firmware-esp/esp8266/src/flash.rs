//! A region of the flash, with `embedded-storage`'s traits.

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};

use crate::platform;

/// Size of an erasable sector [bytes].
pub(crate) const SECTOR: u32 = 4096;

/// A region with addresses relative to its start.
pub(crate) struct Region {
    /// Address of the first byte in the flash; a multiple of [`SECTOR`].
    pub(crate) start: u32,
    /// Length; a multiple of [`SECTOR`] [bytes].
    pub(crate) len: u32,
}

/// A flash operation failed.
#[derive(Debug)]
pub(crate) struct Failed(NorFlashErrorKind);

impl NorFlashError for Failed {
    fn kind(&self) -> NorFlashErrorKind {
        self.0
    }
}

impl From<NorFlashErrorKind> for Failed {
    fn from(kind: NorFlashErrorKind) -> Self {
        Self(kind)
    }
}

fn done(done: bool) -> Result<(), Failed> {
    if done { Ok(()) } else { Err(Failed(NorFlashErrorKind::Other)) }
}

impl ErrorType for Region {
    type Error = Failed;
}

impl ReadNorFlash for Region {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Failed> {
        check_read(self, offset, bytes.len())?;
        done(platform::flash_read(self.start + offset, bytes))
    }

    fn capacity(&self) -> usize {
        self.len as usize
    }
}

impl NorFlash for Region {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = SECTOR as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Failed> {
        check_erase(self, from, to)?;
        for sector in (self.start + from) / SECTOR..(self.start + to) / SECTOR {
            done(platform::flash_erase(sector))?;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Failed> {
        check_write(self, offset, bytes.len())?;
        done(platform::flash_write(self.start + offset, bytes))
    }
}
