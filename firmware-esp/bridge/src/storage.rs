//! Settings in flash. Two sectors are written alternately, so that a power failure during a write leaves the previous
//! settings. Names and values are text: unknown names of a newer firmware are skipped, and missing names keep their
//! defaults.

use embedded_storage::nor_flash::NorFlash;
use sha2::{Digest, Sha256};

use crate::settings::Settings;

/// Maximum length of a record [bytes]; all settings at maximum length use three quarters of it.
const RECORD: usize = 1280;
/// Magic (4), sequence (4), length (2), zero (2), hash (8).
const HEAD: usize = 20;
const MAGIC: [u8; 4] = *b"VZB1";

/// Why settings were not saved.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StoreError {
    /// The flash failed to read, erase or write.
    Flash,
    /// The bytes read back differ.
    Verify,
}

/// Two sectors of a flash that hold the settings.
#[derive(Debug)]
pub struct Store<F> {
    flash: F,
    base: u32,
}

impl<F: NorFlash> Store<F> {
    /// Bytes used from `base` on.
    pub const SIZE: u32 = 2 * F::ERASE_SIZE as u32;

    /// Uses [`Self::SIZE`] bytes from `base` on, which must be the start of a sector.
    pub fn new(flash: F, base: u32) -> Self {
        const { assert!(F::ERASE_SIZE >= RECORD && RECORD.is_multiple_of(F::WRITE_SIZE)) };
        Self { flash, base }
    }

    /// Returns the newest settings; `None` if none are stored.
    pub fn load(&mut self) -> Option<Settings> {
        let mut settings = Settings::default();
        self.load_into(&mut settings).map(|()| settings)
    }

    /// Like [`Self::load`], but writes into existing defaults, because a chip's stack is too small for a copy.
    #[inline(never)] // Why: the record occupies a chip's stack only during this call.
    pub fn load_into(&mut self, settings: &mut Settings) -> Option<()> {
        let mut record = [0; RECORD];
        let (slot, _) = self.newest(&mut record)?;
        self.read(slot, &mut record)?;
        let (_, body) = valid(&record)?;
        for line in body.lines() {
            if let Some((name, value)) = line.split_once('=') {
                // Ignore names of other firmware and values out of range.
                let _ = settings.set(name, value);
            }
        }
        Some(())
    }

    /// Writes settings over the older record.
    ///
    /// # Errors
    /// See [`StoreError`]; the previous settings stay.
    #[inline(never)] // Why: as `load_into`.
    pub fn save(&mut self, settings: &Settings) -> Result<(), StoreError> {
        let mut record = [0; RECORD];
        let (slot, sequence) = match self.newest(&mut record) {
            Some((slot, sequence)) => (1 - slot, sequence.wrapping_add(1)),
            None => (0, 0),
        };
        let len = encode(settings, sequence, &mut record);
        let used = len.next_multiple_of(F::WRITE_SIZE.max(4));
        let at = self.at(slot);
        let flash = &mut self.flash;
        flash.erase(at, at + F::ERASE_SIZE as u32).map_err(|_| StoreError::Flash)?;
        flash.write(at, &record[..used]).map_err(|_| StoreError::Flash)?;
        let hash: [u8; 8] = core::array::from_fn(|i| record[12 + i]);
        self.read(slot, &mut record).ok_or(StoreError::Flash)?;
        match valid(&record) {
            Some((found, _)) if found == sequence && record[12..20] == hash => Ok(()),
            _ => Err(StoreError::Verify),
        }
    }

    /// Erases all settings, keys included. For the button, which needs physical access.
    ///
    /// # Errors
    /// [`StoreError::Flash`].
    pub fn clear(&mut self) -> Result<(), StoreError> {
        self.flash.erase(self.base, self.base + Self::SIZE).map_err(|_| StoreError::Flash)
    }

    pub fn into_flash(self) -> F {
        self.flash
    }

    fn at(&self, slot: u32) -> u32 {
        self.base + slot * F::ERASE_SIZE as u32
    }

    fn read(&mut self, slot: u32, record: &mut [u8; RECORD]) -> Option<()> {
        let at = self.at(slot);
        self.flash.read(at, record).ok()
    }

    /// Returns slot and sequence of the newest valid record.
    fn newest(&mut self, record: &mut [u8; RECORD]) -> Option<(u32, u32)> {
        let mut newest: Option<(u32, u32)> = None;
        for slot in 0..2 {
            if self.read(slot, record).is_none() {
                continue;
            }
            let Some((sequence, _)) = valid(record) else { continue };
            let newer = newest.is_none_or(|(_, known)| sequence.wrapping_sub(known) < u32::MAX / 2);
            if newer {
                newest = Some((slot, sequence));
            }
        }
        newest
    }
}

fn encode(settings: &Settings, sequence: u32, record: &mut [u8; RECORD]) -> usize {
    record.fill(0);
    let mut len = HEAD;
    settings.each(|name, value| {
        for part in [name, "=", value, "\n"] {
            // All settings at maximum length fit, see the test.
            if let Some(place) = record.get_mut(len..len + part.len()) {
                place.copy_from_slice(part.as_bytes());
                len += part.len();
            }
        }
    });
    record[..4].copy_from_slice(&MAGIC);
    record[4..8].copy_from_slice(&sequence.to_le_bytes());
    record[8..10].copy_from_slice(&((len - HEAD) as u16).to_le_bytes());
    let hash = hash(record, len);
    record[12..20].copy_from_slice(&hash);
    len
}

/// Returns sequence and body of a valid record.
fn valid(record: &[u8; RECORD]) -> Option<(u32, &str)> {
    let len = HEAD + usize::from(u16::from_le_bytes([record[8], record[9]]));
    if record[..4] != MAGIC || len > RECORD || record[12..20] != hash(record, len) {
        return None;
    }
    let sequence = u32::from_le_bytes([record[4], record[5], record[6], record[7]]);
    Some((sequence, core::str::from_utf8(&record[HEAD..len]).ok()?))
}

/// Returns the hash of a record: all bytes except the hash field.
fn hash(record: &[u8; RECORD], len: usize) -> [u8; 8] {
    let whole =
        Sha256::new().chain_update(&record[..12]).chain_update(&record[HEAD..len]).finalize();
    core::array::from_fn(|at| whole[at])
}

#[cfg(test)]
pub(crate) mod tests;
