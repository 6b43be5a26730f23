//! Initial settings of a flash, with a new key in every file.

use std::fs::File;
use std::io::Read;

use anyhow::{Context as _, Result, anyhow};
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use vizflyt_bridge::Settings;
use vizflyt_bridge::settings::typed_key;
use vizflyt_bridge::storage::Store;

/// Password of the bridge's own network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Access {
    /// A new random key.
    Random,
    /// The given key.
    Given(String),
    /// No key: anyone in range can join.
    Open,
}

/// Initial settings.
pub(crate) struct First {
    /// Content of the settings' region: two sectors.
    pub(crate) flash: Vec<u8>,
    /// Key to print; `None` if the network is open.
    pub(crate) key: Option<String>,
}

/// Returns the initial settings.
pub(crate) fn first(access: &Access) -> Result<First> {
    let mut settings = Settings::default();
    let mut set = |name: &str, value: &str| {
        let refused = |why| anyhow!("{name} is refused: {why:?}; a key has 8 to 63 characters");
        settings.set(name, value).map_err(refused)
    };
    let key = match access {
        Access::Open => {
            set("WIFI_OPEN", "1")?;
            None
        }
        Access::Random => {
            let mut random = [0; 16];
            File::open("/dev/urandom")
                .and_then(|mut file| file.read_exact(&mut random))
                .context("no random numbers from /dev/urandom for a key")?;
            Some(typed_key(&random).to_string())
        }
        Access::Given(key) => Some(key.clone()),
    };
    if let Some(key) = &key {
        set("wifi.ap_password", key)?;
        set("page.key", key)?;
    }
    let mut store = Store::new(Memory(vec![0xFF; Store::<Memory>::SIZE as usize]), 0);
    store.save(&settings).map_err(|error| anyhow!("the settings do not fit: {error:?}"))?;
    Ok(First { flash: store.into_flash().0, key })
}

/// Flash in memory: erased bytes are ones, writes clear bits.
struct Memory(Vec<u8>);

impl ErrorType for Memory {
    type Error = NorFlashErrorKind;
}

impl Memory {
    fn place(&mut self, from: u32, len: usize) -> Result<&mut [u8], NorFlashErrorKind> {
        let from = from as usize;
        self.0.get_mut(from..from + len).ok_or(NorFlashErrorKind::OutOfBounds)
    }
}

impl ReadNorFlash for Memory {
    const READ_SIZE: usize = 4;

    fn read(&mut self, from: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        bytes.copy_from_slice(self.place(from, bytes.len())?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.len()
    }
}

impl NorFlash for Memory {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        self.place(from, (to - from) as usize)?.fill(0xFF);
        Ok(())
    }

    fn write(&mut self, from: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        for (cell, byte) in self.place(from, bytes.len())?.iter_mut().zip(bytes) {
            *cell &= byte;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(first: &First) -> Settings {
        Store::new(Memory(first.flash.clone()), 0).load().unwrap()
    }

    #[test]
    fn every_image_has_a_new_key() {
        let made = [first(&Access::Random).unwrap(), first(&Access::Random).unwrap()];
        for one in &made {
            let (settings, key) = (read(one), one.key.as_deref().unwrap());
            assert_eq!((&*settings.ap_password, &*settings.page_key), (key, key));
            assert!(!settings.wifi_open && key.len() == 19);
        }
        assert_ne!(made[0].key, made[1].key);
    }

    #[test]
    fn opens_the_network_only_on_request() {
        let open = first(&Access::Open).unwrap();
        let settings = read(&open);
        assert!(settings.wifi_open && settings.ap_password.is_empty() && open.key.is_none());
        let given = first(&Access::Given("correct horse".to_owned())).unwrap();
        assert_eq!(&*read(&given).ap_password, "correct horse");
        assert!(first(&Access::Given("short".to_owned())).is_err());
    }
}
