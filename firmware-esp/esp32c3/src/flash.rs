//! A region of the flash, with `embedded-storage`'s traits.

use core::cell::RefCell;

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, ReadNorFlash, check_erase, check_read, check_write,
};
use esp_storage::{FlashStorage, FlashStorageError};

/// The complete flash, shared by several regions. Only one task uses it, so it is never borrowed twice.
pub(crate) type Flash = RefCell<FlashStorage<'static>>;

/// A region with addresses relative to its start.
pub(crate) struct Region {
    pub(crate) flash: &'static Flash,
    /// Address of the first byte; a multiple of the sector size.
    pub(crate) start: u32,
    /// Length; a multiple of the sector size [bytes].
    pub(crate) len: u32,
}

impl ErrorType for Region {
    type Error = FlashStorageError;
}

fn outside(_: embedded_storage::nor_flash::NorFlashErrorKind) -> FlashStorageError {
    FlashStorageError::OutOfBounds
}

impl ReadNorFlash for Region {
    const READ_SIZE: usize = <FlashStorage<'static> as ReadNorFlash>::READ_SIZE;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashStorageError> {
        check_read(self, offset, bytes.len()).map_err(outside)?;
        ReadNorFlash::read(&mut *self.flash.borrow_mut(), self.start + offset, bytes)
    }

    fn capacity(&self) -> usize {
        self.len as usize
    }
}

impl NorFlash for Region {
    const WRITE_SIZE: usize = <FlashStorage<'static> as NorFlash>::WRITE_SIZE;
    const ERASE_SIZE: usize = <FlashStorage<'static> as NorFlash>::ERASE_SIZE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashStorageError> {
        check_erase(self, from, to).map_err(outside)?;
        NorFlash::erase(&mut *self.flash.borrow_mut(), self.start + from, self.start + to)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashStorageError> {
        check_write(self, offset, bytes.len()).map_err(outside)?;
        NorFlash::write(&mut *self.flash.borrow_mut(), self.start + offset, bytes)
    }
}

/// Returns the region of the settings: `settings` in `partitions.csv`.
pub(crate) fn settings(flash: &'static Flash) -> Region {
    Region { flash, start: 0x9000, len: 0x4000 }
}
