extern crate std;

use std::vec;
use std::vec::Vec;

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

use super::*;

/// Flash in memory: writes only clear bits, and the power fails after `power` bytes.
#[derive(Clone, Debug)]
pub(crate) struct Memory {
    pub(crate) bytes: Vec<u8>,
    pub(crate) power: usize,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct PowerCut;

impl NorFlashError for PowerCut {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl ErrorType for Memory {
    type Error = PowerCut;
}

impl ReadNorFlash for Memory {
    const READ_SIZE: usize = 4;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), PowerCut> {
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl Memory {
    /// Returns erased flash with unlimited power.
    pub(crate) fn of(len: usize) -> Self {
        Self { bytes: vec![0xFF; len], power: usize::MAX }
    }

    fn spend(&mut self) -> Result<(), PowerCut> {
        self.power = self.power.checked_sub(1).ok_or(PowerCut)?;
        Ok(())
    }
}

impl NorFlash for Memory {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), PowerCut> {
        assert!(from.is_multiple_of(4096) && to.is_multiple_of(4096));
        for at in from..to {
            self.spend()?;
            self.bytes[at as usize] = 0xFF;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), PowerCut> {
        assert!(offset.is_multiple_of(4) && bytes.len().is_multiple_of(4));
        for (at, byte) in bytes.iter().enumerate() {
            self.spend()?;
            self.bytes[offset as usize + at] &= byte;
        }
        Ok(())
    }
}

fn store() -> Store<Memory> {
    Store::new(Memory::of(3 * 4096), 4096)
}

fn with_loss(loss_ms: u16) -> Settings {
    Settings { loss_ms, key: Some([loss_ms as u8; 32]), ..Settings::default() }
}

#[test]
fn loads_the_newest_settings() {
    let mut store = store();
    assert_eq!(store.load(), None);
    for loss_ms in [300, 400, 500, 600, 700] {
        store.save(&with_loss(loss_ms)).unwrap();
        assert_eq!(store.load(), Some(with_loss(loss_ms)));
    }
    store.clear().unwrap();
    assert_eq!(store.load(), None);
}

#[test]
fn the_longest_settings_fit() {
    let mut longest = Settings::default();
    for name in ["wifi.ssid", "wifi.ap_ssid", "hostname"] {
        longest.set(name, "n".repeat(32).as_str()).unwrap();
    }
    for name in ["wifi.password", "wifi.ap_password", "page.key"] {
        longest.set(name, "p".repeat(63).as_str()).unwrap();
    }
    longest.set("address", "192.168.100.100/24").unwrap();
    longest.set("gateway", "192.168.100.100").unwrap();
    longest.set("client", "192.168.100.100:65535").unwrap();
    for name in ["key", "vehicle.key"] {
        longest.set(name, "ab".repeat(32).as_str()).unwrap();
    }
    longest.set("wifi.country", "DE").unwrap();
    for number in crate::settings::NUMBERS {
        number.set(&mut longest, number.most).unwrap();
    }
    let mut store = store();
    store.save(&longest).unwrap();
    assert_eq!(store.load(), Some(longest));
}

/// The power may fail at any byte: afterwards, either the old or the new settings are read.
#[test]
fn a_power_failure_leaves_old_or_new_settings() {
    let mut whole = store();
    whole.save(&with_loss(300)).unwrap();
    whole.save(&with_loss(400)).unwrap();
    let mut new = 0;
    for power in (0..6000).step_by(7) {
        let mut store = Store::new(Memory { power, ..whole.flash.clone() }, 4096);
        let saved = store.save(&with_loss(500));
        store.flash.power = usize::MAX;
        let found = store.load().unwrap();
        let expected = if found.loss_ms == 500 { 500 } else { 400 };
        assert_eq!(found, with_loss(expected), "after {power} bytes");
        assert!(saved.is_err() || expected == 500);
        new += u32::from(expected == 500);
    }
    assert!(new > 0, "saved if the power lasts");
}
