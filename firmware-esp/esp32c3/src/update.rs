//! Firmware updates over the network: the spare slot of the flash, and the trial of new firmware. A firmware built
//! without a key accepts no updates.

use core::ops::DerefMut as _;

use esp_bootloader_esp_idf::ota_updater::OtaUpdater;
use esp_bootloader_esp_idf::partitions::{
    AppPartitionSubType, Error, PARTITION_TABLE_MAX_LEN, PartitionType, read_partition_table,
};
use vizflyt_bridge::settings::key_from_hex;
use vizflyt_bridge::update::{Fault, Slots, StartAction, Target, Trial, Updater, Wanted};

use crate::flash::{self, Flash, Region};

/// Public key of the firmware's signer, as printed by `vizflyt bridge firmware key`.
const KEY: Option<[u8; 32]> = match option_env!("VIZFLYT_FIRMWARE_KEY") {
    Some(text) => match key_from_hex(text) {
        Ok(key) => Some(key),
        Err(_) => panic!("VIZFLYT_FIRMWARE_KEY is not 64 hexadecimal digits"),
    },
    None => None,
};

/// Build number of this firmware; older ones are rejected.
const BUILD: u32 = match option_env!("VIZFLYT_FIRMWARE_BUILD") {
    Some(text) => match u32::from_str_radix(text, 10) {
        Ok(build) => build,
        Err(_) => panic!("VIZFLYT_FIRMWARE_BUILD is not a number"),
    },
    None => 0,
};

/// Returns the record of a trial: the last sector of the settings' region.
fn trial(flash: &'static Flash) -> Trial<Region> {
    let settings = flash::settings(flash);
    let base = settings.len - 0x1000;
    Trial::new(settings, base)
}

/// Counts a start of this firmware, if it is on trial. If it has used all its starts, switches to the previous
/// firmware and restarts. Call it before anything that may fail. Returns whether this firmware is on trial.
pub(crate) fn start(flash: &'static Flash) -> bool {
    match trial(flash).start() {
        Ok(StartAction::OnTrial) => true,
        Ok(StartAction::GoBack) => {
            if Halves::of(flash).is_some_and(|mut halves| halves.select_spare().is_ok()) {
                esp_hal::system::software_reset();
            }
            false
        }
        Ok(StartAction::Settled) | Err(_) => false,
    }
}

/// Ends the trial and keeps this firmware.
pub(crate) fn keep(flash: &'static Flash) {
    // If the flash write fails, the chip rolls back to the previous firmware, which is acceptable.
    let _ = trial(flash).keep();
}

/// Receiver of new firmware.
pub(crate) struct Updates {
    wanted: Wanted,
    halves: Halves,
    updater: Option<Updater>,
}

impl Updates {
    /// Returns `None` if this firmware has no key, or if the flash does not show which slot runs.
    pub(crate) fn new(flash: &'static Flash) -> Option<Self> {
        let wanted = Wanted { target: Target::Esp32C3, build: BUILD, key: KEY? };
        Some(Self { wanted, halves: Halves::of(flash)?, updater: None })
    }

    /// Takes the next bytes; see [`vizflyt_bridge::shell::Platform::update`].
    pub(crate) fn take(&mut self, first: bool, bytes: &[u8]) -> Result<bool, &'static str> {
        if first {
            self.updater = None;
        }
        let updater = self.updater.get_or_insert_with(|| Updater::new(self.wanted));
        updater.feed(&mut self.halves, bytes).map_err(Fault::message)
    }
}

/// Slot that is not running.
struct Halves {
    flash: &'static Flash,
    region: Region,
    name: AppPartitionSubType,
}

impl Halves {
    /// Finds the running slot, and the spare one.
    fn of(flash: &'static Flash) -> Option<Self> {
        let mut table = [0; PARTITION_TABLE_MAX_LEN];
        let table = read_partition_table(flash.borrow_mut().deref_mut(), &mut table).ok()?;
        let running = table.booted_partition().ok()??.partition_type();
        let name = match running {
            PartitionType::App(AppPartitionSubType::Ota0) => AppPartitionSubType::Ota1,
            PartitionType::App(AppPartitionSubType::Ota1) => AppPartitionSubType::Ota0,
            _ => return None,
        };
        let spare = table.find_partition(PartitionType::App(name)).ok()??;
        let region = Region { flash, start: spare.offset(), len: spare.len() };
        Some(Self { flash, region, name })
    }

    /// Makes the bootloader start the spare slot.
    fn select_spare(&mut self) -> Result<(), Error> {
        let mut flash = self.flash.borrow_mut();
        let mut table = [0; PARTITION_TABLE_MAX_LEN];
        let mut updater = OtaUpdater::new(flash.deref_mut(), &mut table)?;
        let mut choice = updater.ota_data()?;
        if choice.current_app_partition()? == AppPartitionSubType::Factory {
            // No slot was ever selected, so the first one runs. Its sequence number is the base of the next.
            choice.set_current_app_partition(AppPartitionSubType::Ota0)?;
        }
        choice.set_current_app_partition(self.name)
    }
}

impl Slots for Halves {
    type Spare = Region;

    fn spare(&mut self) -> &mut Region {
        &mut self.region
    }

    fn start_spare(&mut self) -> bool {
        trial(self.flash).begin().is_ok() && self.select_spare().is_ok()
    }
}
