//! Which of the two programs in flash runs, and that it came up: `ota_0`, `ota_1` and `otadata` in
//! `partitions.csv`.

use esp_bootloader_esp_idf::ota::OtaImageState;
use esp_bootloader_esp_idf::ota_updater::OtaUpdater;
use esp_bootloader_esp_idf::partitions::PARTITION_TABLE_MAX_LEN;
use esp_println::println;

use crate::flash::Flash;

/// Tells the second-stage loader that this program works, so that it starts it again. One that
/// dies before it gets here is given up by a loader that was built to (ESP-IDF's
/// `BOOTLOADER_APP_ROLLBACK_ENABLE`), for the program before it.
pub(crate) fn came_up(flash: &Flash) {
    let mut table = [0; PARTITION_TABLE_MAX_LEN];
    let mut flash = flash.borrow_mut();
    let state = OtaUpdater::new(&mut flash, &mut table).and_then(|mut updater| {
        match updater.current_ota_state()? {
            OtaImageState::New | OtaImageState::PendingVerify => {
                updater.set_current_ota_state(OtaImageState::Valid)
            }
            _ => Ok(()),
        }
    });
    // Flashed over USB there is no record yet.
    if let Err(error) = state {
        println!("no record of updates: {error:?}");
    }
}
