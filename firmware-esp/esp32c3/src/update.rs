//! Firmware over the network: the half of the flash that does not run, and the trial of a new one.
//! A firmware built without a key takes none.

use core::ops::DerefMut as _;

use esp_bootloader_esp_idf::ota_updater::OtaUpdater;
use esp_bootloader_esp_idf::partitions::{
    AppPartitionSubType, Error, PARTITION_TABLE_MAX_LEN, PartitionType, read_partition_table,
};
use vizflyt_bridge::settings::key_from_hex;
use vizflyt_bridge::update::{Fault, Slots, StartAction, Target, Trial, Updater, Wanted};

use crate::flash::{self, Flash, Region};

/// The public half of the key that signs, as `vizflyt bridge firmware key` prints it.
const KEY: Option<[u8; 32]> = match option_env!("VIZFLYT_FIRMWARE_KEY") {
    Some(text) => match key_from_hex(text) {
        Ok(key) => Some(key),
        Err(_) => panic!("VIZFLYT_FIRMWARE_KEY is not 64 hexadecimal digits"),
    },
    None => None,
};

/// This firmware's number; older ones are not taken.
const BUILD: u32 = match option_env!("VIZFLYT_FIRMWARE_BUILD") {
    Some(text) => match u32::from_str_radix(text, 10) {
        Ok(build) => build,
        Err(_) => panic!("VIZFLYT_FIRMWARE_BUILD is not a number"),
    },
    None => 0,
};

/// The record of a trial: the last sector of the settings' region.
fn trial(flash: &'static Flash) -> Trial<Region> {
    let settings = flash::settings(flash);
    let base = settings.len - 0x1000;
    Trial::new(settings, base)
}

/// Counts this start of a firmware on trial; one that had its starts gives way to the one before.
/// Comes before everything that may fail. Returns whether this one is on trial.
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

/// Ends the trial: this firmware stays.
pub(crate) fn keep(flash: &'static Flash) {
    // A flash that does not take it sends the chip back to the firmware before: also a way.
    let _ = trial(flash).keep();
}

/// What takes a new firmware.
pub(crate) struct Updates {
    wanted: Wanted,
    halves: Halves,
    updater: Option<Updater>,
}

impl Updates {
    /// Returns `None` if this firmware has no key, or the flash does not show which half runs.
    pub(crate) fn new(flash: &'static Flash) -> Option<Self> {
        let wanted = Wanted { target: Target::Esp32C3, build: BUILD, key: KEY? };
        Some(Self { wanted, halves: Halves::of(flash)?, updater: None })
    }

    /// Takes the next bytes; see `shell::Platform::update`.
    pub(crate) fn take(&mut self, first: bool, bytes: &[u8]) -> Result<bool, &'static str> {
        if first {
            self.updater = None;
        }
        let updater = self.updater.get_or_insert_with(|| Updater::new(self.wanted));
        updater.feed(&mut self.halves, bytes).map_err(Fault::message)
    }
}

/// The half that does not run.
struct Halves {
    flash: &'static Flash,
    region: Region,
    name: AppPartitionSubType,
}

impl Halves {
    /// Looks up what runs.
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

    /// Makes the loader start this half.
    fn select_spare(&mut self) -> Result<(), Error> {
        let mut flash = self.flash.borrow_mut();
        let mut table = [0; PARTITION_TABLE_MAX_LEN];
        let mut updater = OtaUpdater::new(flash.deref_mut(), &mut table)?;
        let mut choice = updater.ota_data()?;
        if choice.current_app_partition()? == AppPartitionSubType::Factory {
            // Nothing was ever chosen, so the first half runs. Its number is counted on from.
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
