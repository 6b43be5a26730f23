//! Signed firmware updates with rollback.
//!
//! ```text
//! header: signature valid? for this chip? not older? ─▶ spare slot: erase, write ─▶ read back, hash
//!        ─▶ boot on trial ─▶ healthy? keep it : after three starts, roll back
//! ```
//! Nothing is erased before the signature is verified, and the running slot is never written, so power may fail at any
//! time. A chip without two slots implements no [`Slots`] and has no updates.

use ed25519_dalek::{Signature, VerifyingKey};
use embedded_storage::nor_flash::{NorFlash, ReadNorFlash};
use sha2::{Digest, Sha256};

/// Length of the header before a firmware [bytes].
pub const HEADER: usize = 112;
/// First bytes of the header.
pub const MAGIC: [u8; 4] = *b"VZU1";
/// Length of the signed part of the header [bytes]. [`CONTEXT`] binds a signature to its purpose.
const SIGNED: usize = 48;
const CONTEXT: &[u8] = b"vizflyt bridge firmware 1";

/// Chip that a firmware is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Target {
    /// The host: `vizflyt bridge emulate`, and tests.
    Host = 0,
    /// ESP32-C3.
    Esp32C3 = 1,
    /// ESP8266.
    Esp8266 = 2,
}

/// Header of a firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Number of the [`Target`].
    pub target: u8,
    /// Build number; a bridge rejects firmware with a smaller one than it runs.
    pub build: u32,
    /// Length of the firmware behind the header [bytes].
    pub len: u32,
    /// SHA-256 of the firmware.
    pub hash: [u8; 32],
}

impl Header {
    /// Returns the message to sign: [`CONTEXT`] and the header's bytes.
    fn message(&self) -> [u8; CONTEXT.len() + SIGNED] {
        let mut message = [0; CONTEXT.len() + SIGNED];
        message[..CONTEXT.len()].copy_from_slice(CONTEXT);
        let head = &mut message[CONTEXT.len()..];
        head[..4].copy_from_slice(&MAGIC);
        head[4] = self.target;
        head[8..12].copy_from_slice(&self.build.to_le_bytes());
        head[12..16].copy_from_slice(&self.len.to_le_bytes());
        head[16..48].copy_from_slice(&self.hash);
        message
    }

    /// Returns the header's bytes; `sign` must sign its argument with Ed25519.
    pub fn sign(&self, sign: impl FnOnce(&[u8]) -> [u8; 64]) -> [u8; HEADER] {
        let message = self.message();
        let mut bytes = [0; HEADER];
        bytes[..SIGNED].copy_from_slice(&message[CONTEXT.len()..]);
        bytes[SIGNED..].copy_from_slice(&sign(&message));
        bytes
    }

    /// Reads a header and verifies its signature.
    ///
    /// # Errors
    /// [`Fault::NoFirmware`] and [`Fault::Signature`].
    pub fn open(bytes: &[u8; HEADER], key: &[u8; 32]) -> Result<Self, Fault> {
        let word = |at: usize| {
            u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        };
        let header = Self {
            target: bytes[4],
            build: word(8),
            len: word(12),
            hash: core::array::from_fn(|at| bytes[16 + at]),
        };
        let message = header.message();
        if bytes[..SIGNED] != message[CONTEXT.len()..] {
            return Err(Fault::NoFirmware);
        }
        let signature = Signature::from_bytes(&core::array::from_fn(|at| bytes[SIGNED + at]));
        VerifyingKey::from_bytes(key)
            .and_then(|key| key.verify_strict(&message, &signature))
            .map_err(|_| Fault::Signature)?;
        Ok(header)
    }
}

/// Why a firmware is rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The bytes are not a bridge firmware.
    NoFirmware,
    /// The signature is not by the bridge's firmware key.
    Signature,
    /// The firmware is for another chip.
    OtherChip,
    /// The firmware is older than the running one.
    Older,
    /// The firmware does not fit the spare slot.
    TooLong,
    /// The flash failed, or the bytes read back differ.
    Flash,
    /// The received bytes differ from the signed ones.
    Damaged,
}

impl Fault {
    /// Returns the fault in words.
    pub fn message(self) -> &'static str {
        match self {
            Self::NoFirmware => "not a bridge firmware",
            Self::Signature => "the signature is not of this bridge's firmware key",
            Self::OtherChip => "the firmware is for another chip",
            Self::Older => "the firmware is older than the one that runs",
            Self::TooLong => "the firmware does not fit the chip",
            Self::Flash => "the flash failed to erase, write or verify",
            Self::Damaged => "the received bytes differ from the signed firmware",
        }
    }
}

/// Two firmware slots of a chip.
pub trait Slots {
    /// Slot that is not running, from address 0 on.
    type Spare: NorFlash;

    /// Returns the slot that is not running.
    fn spare(&mut self) -> &mut Self::Spare;

    /// Makes the chip start the spare slot from now on, on trial. Returns whether that succeeded.
    fn start_spare(&mut self) -> bool;
}

/// Requirements on a firmware.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Chip of this bridge.
    pub target: Target,
    /// Build number of the running firmware.
    pub build: u32,
    /// Public key that verifies firmware.
    pub key: [u8; 32],
}

/// Bytes written to flash at once: a page of every NOR flash.
const PAGE: usize = 256;

/// Receives a firmware in portions of any size.
#[derive(Debug)]
pub struct Updater {
    wanted: Wanted,
    header: [u8; HEADER],
    head_len: usize,
    open: Option<Header>,
    page: [u8; PAGE],
    page_len: usize,
    written: u32,
}

impl Updater {
    /// Returns an updater that waits for the first byte.
    pub fn new(wanted: Wanted) -> Self {
        Self {
            wanted,
            header: [0; HEADER],
            head_len: 0,
            open: None,
            page: [0; PAGE],
            page_len: 0,
            written: 0,
        }
    }

    /// Takes bytes. Returns true with the last ones, when the firmware is complete and verified, and will start next.
    ///
    /// # Errors
    /// See [`Fault`]. The running firmware stays.
    pub fn feed<S: Slots>(&mut self, slots: &mut S, mut bytes: &[u8]) -> Result<bool, Fault> {
        let header = if let Some(header) = self.open {
            header
        } else {
            let taken = bytes.len().min(HEADER - self.head_len);
            self.header[self.head_len..self.head_len + taken].copy_from_slice(&bytes[..taken]);
            self.head_len += taken;
            bytes = &bytes[taken..];
            if self.head_len < HEADER {
                return Ok(false);
            }
            let header = Header::open(&self.header, &self.wanted.key)?;
            self.judge(&header, slots.spare().capacity())?;
            self.open = Some(header);
            header
        };
        while !bytes.is_empty() {
            let left = header.len - self.written - self.page_len as u32;
            let taken = bytes.len().min(PAGE - self.page_len).min(left as usize);
            if taken == 0 {
                return Err(Fault::Damaged);
            }
            self.page[self.page_len..self.page_len + taken].copy_from_slice(&bytes[..taken]);
            self.page_len += taken;
            bytes = &bytes[taken..];
            if self.page_len == PAGE || self.written + self.page_len as u32 == header.len {
                self.write_page(slots.spare())?;
            }
        }
        if self.written < header.len {
            return Ok(false);
        }
        verify(slots.spare(), &header)?;
        if slots.start_spare() { Ok(true) } else { Err(Fault::Flash) }
    }

    /// Returns the build number of the incoming firmware, once its header is verified.
    pub fn build(&self) -> Option<u32> {
        self.open.map(|header| header.build)
    }

    fn judge(&self, header: &Header, capacity: usize) -> Result<(), Fault> {
        if header.target != self.wanted.target as u8 {
            Err(Fault::OtherChip)
        } else if header.build < self.wanted.build {
            Err(Fault::Older)
        } else if header.len == 0 || header.len as usize > capacity {
            Err(Fault::TooLong)
        } else {
            Ok(())
        }
    }

    fn write_page<F: NorFlash>(&mut self, flash: &mut F) -> Result<(), Fault> {
        const { assert!(PAGE.is_multiple_of(F::WRITE_SIZE) && F::ERASE_SIZE.is_multiple_of(PAGE)) };
        let sector = F::ERASE_SIZE as u32;
        let at = self.written;
        if at.is_multiple_of(sector) {
            flash.erase(at, at + sector).map_err(|_| Fault::Flash)?;
        }
        self.page[self.page_len..].fill(0xFF);
        let len = self.page_len.next_multiple_of(F::WRITE_SIZE);
        flash.write(at, &self.page[..len]).map_err(|_| Fault::Flash)?;
        self.written += self.page_len as u32;
        self.page_len = 0;
        Ok(())
    }
}

/// Verifies the hash of the spare slot.
fn verify<F: NorFlash>(flash: &mut F, header: &Header) -> Result<(), Fault> {
    let (mut hash, mut at, mut page) = (Sha256::new(), 0, [0; PAGE]);
    while at < header.len {
        let len = (header.len - at).min(PAGE as u32) as usize;
        let read = len.next_multiple_of(F::READ_SIZE.max(1));
        flash.read(at, &mut page[..read]).map_err(|_| Fault::Flash)?;
        hash.update(&page[..len]);
        at += len as u32;
    }
    if hash.finalize()[..] == header.hash { Ok(()) } else { Err(Fault::Damaged) }
}

/// Starts within which a new firmware must become healthy.
pub const STARTS: u32 = 3;
const ON_TRIAL: u32 = 0x7A17_5A17;

/// Record of a trial in one sector of flash. Its bits only change from 1 to 0 between two updates, so that starts are
/// counted without erasing. For chips whose loader does not count.
#[derive(Debug)]
pub struct Trial<F> {
    flash: F,
    base: u32,
}

/// Action at a start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StartAction {
    /// Run; not on trial.
    Settled,
    /// Run, and call [`Trial::keep`] once healthy.
    OnTrial,
    /// Start the previous slot: this one used all its starts.
    GoBack,
}

impl<F: NorFlash> Trial<F> {
    /// Uses the sector that starts at `base`.
    pub fn new(flash: F, base: u32) -> Self {
        const { assert!(F::WRITE_SIZE <= 4 && F::READ_SIZE <= 4) };
        Self { flash, base }
    }

    /// Begins a trial. Call it before [`Slots::start_spare`].
    ///
    /// # Errors
    /// [`Fault::Flash`].
    pub fn begin(&mut self) -> Result<(), Fault> {
        let end = self.base + F::ERASE_SIZE as u32;
        self.flash.erase(self.base, end).map_err(|_| Fault::Flash)?;
        self.write(0, ON_TRIAL)
    }

    /// Counts a start. Returns the action.
    ///
    /// # Errors
    /// [`Fault::Flash`]; run the firmware then, because a flash that cannot count cannot switch either.
    pub fn start(&mut self) -> Result<StartAction, Fault> {
        if self.read(0)? != ON_TRIAL || self.read(4)? == 0 {
            return Ok(StartAction::Settled);
        }
        let left = self.read(8)?;
        let starts = left.count_zeros();
        if starts >= STARTS {
            self.write(4, 0)?;
            return Ok(StartAction::GoBack);
        }
        self.write(8, left << 1)?;
        Ok(StartAction::OnTrial)
    }

    /// Ends the trial and keeps the firmware.
    ///
    /// # Errors
    /// [`Fault::Flash`].
    pub fn keep(&mut self) -> Result<(), Fault> {
        if self.read(0)? == ON_TRIAL { self.write(4, 0) } else { Ok(()) }
    }

    fn read(&mut self, at: u32) -> Result<u32, Fault> {
        let mut word = [0; 4];
        self.flash.read(self.base + at, &mut word).map_err(|_| Fault::Flash)?;
        Ok(u32::from_le_bytes(word))
    }

    fn write(&mut self, at: u32, word: u32) -> Result<(), Fault> {
        self.flash.write(self.base + at, &word.to_le_bytes()).map_err(|_| Fault::Flash)
    }
}

#[cfg(test)]
mod tests;
