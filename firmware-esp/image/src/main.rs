//! Makes the files to flash of the ESP32-C3's bridge: one with bootloader, partition table and program for the first
//! flashing over USB, and one with only the program for updates over the network.
//!
//! `vizflyt-bridge-image [--open | --key KEY] ELF PARTITIONS.csv FOLDER` `vizflyt-bridge-image [--open | --key KEY]
//! --settings FILE`
//!
//! The first file contains settings: a key, new for every file, which is the password of the bridge's own network and
//! opens its settings in a browser. The key is only printed, not stored elsewhere. `--settings` makes only the
//! settings, for a chip whose program another tool writes.

mod settings;

use std::path::Path;
use std::{env, fs};

use settings::Access;

use anyhow::{Context as _, Result, bail};
use espflash::flasher::{FlashData, FlashMode, FlashSettings, FlashSize};
use espflash::image_format::idf::IdfBootloaderFormat;
use espflash::target::{Chip, XtalFrequency};

/// Flash size of all boards in the guide; an image for 4 MB also runs on larger flash.
const FLASH: FlashSize = FlashSize::_4Mb;

/// Address of the settings: `settings` in `partitions.csv`.
const SETTINGS: usize = 0x9000;

fn main() -> Result<()> {
    let mut arguments: Vec<String> = env::args().skip(1).collect();
    let access = match arguments.first().map(String::as_str) {
        Some("--open") => {
            arguments.remove(0);
            Access::Open
        }
        Some("--key") if arguments.len() > 1 => {
            arguments.remove(0);
            Access::Given(arguments.remove(0))
        }
        _ => Access::Random,
    };
    let first = settings::first(&access)?;
    let (elf, partitions, folder) = match &arguments[..] {
        [flag, file] if flag == "--settings" => {
            fs::write(file, &first.flash).with_context(|| format!("cannot write {file}"))?;
            println!("{file}: {} bytes", first.flash.len());
            print_key(first.key.as_deref());
            return Ok(());
        }
        [elf, partitions, folder] => (elf, partitions, folder),
        _ => bail!(
            "usage: vizflyt-bridge-image [--open | --key KEY] ELF PARTITIONS.csv FOLDER
       vizflyt-bridge-image [--open | --key KEY] --settings FILE"
        ),
    };
    let bytes = fs::read(elf).with_context(|| format!("cannot read {elf}; build it first"))?;
    let folder = Path::new(folder);
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;

    let settings = FlashSettings::new(Some(FlashMode::Dio), Some(FLASH), None);
    let data = FlashData::new(settings, 0, None, Chip::Esp32c3, XtalFrequency::_40Mhz);
    let format = || {
        IdfBootloaderFormat::new(&bytes, &data, Some(Path::new(partitions)), None, None, None)
            .with_context(|| format!("cannot make an image of {elf} with {partitions}"))
    };

    let mut whole = Vec::new();
    for segment in format()?.flash_segments() {
        let start = segment.addr as usize;
        if start < whole.len() {
            bail!(
                "the segment at {start:#x} overlaps the previous one, which ends at {:#x}",
                whole.len()
            );
        }
        // Erased flash in between.
        whole.resize(start, 0xFF);
        whole.extend_from_slice(segment.data());
    }
    // The bootloader format does not include the settings' region.
    whole[SETTINGS..SETTINGS + first.flash.len()].copy_from_slice(&first.flash);
    let mut program = Vec::new();
    for segment in format()?.ota_segments() {
        program.extend_from_slice(segment.data());
    }
    for (name, content) in [("bridge-esp32c3.bin", &whole), ("bridge-esp32c3-update.bin", &program)]
    {
        let path = folder.join(name);
        fs::write(&path, content).with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}: {} bytes", path.display(), content.len());
    }
    print_key(first.key.as_deref());
    Ok(())
}

/// Prints the key, because it cannot be read from the bridge later.
fn print_key(key: Option<&str>) {
    match key {
        Some(key) => {
            println!("key of its network, and of its settings in a browser: {key}");
            println!("write it down; another file has another key");
        }
        None => println!("its network is open: anyone in range can join"),
    }
}
