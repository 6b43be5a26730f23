//! Makes what is flashed of the ESP32-C3's bridge: one file with bootloader, partition table and
//! program for the first time, over USB, and the program alone for updates over the network.
//!
//! `vizflyt-bridge-image ELF PARTITIONS.csv FOLDER`

use std::path::Path;
use std::{env, fs};

use anyhow::{Context as _, Result, bail};
use espflash::flasher::{FlashData, FlashMode, FlashSettings, FlashSize};
use espflash::image_format::idf::IdfBootloaderFormat;
use espflash::target::{Chip, XtalFrequency};

/// What every board of the guide has; an image for 4 MB runs on larger flash too.
const FLASH: FlashSize = FlashSize::_4Mb;

fn main() -> Result<()> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [elf, partitions, folder] = &arguments[..] else {
        bail!("usage: vizflyt-bridge-image ELF PARTITIONS.csv FOLDER");
    };
    let bytes = fs::read(elf).with_context(|| format!("cannot read {elf}; build it first"))?;
    let folder = Path::new(folder);
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;

    let settings = FlashSettings::new(Some(FlashMode::Dio), Some(FLASH), None);
    let data = FlashData::new(settings, 0, None, Chip::Esp32c3, XtalFrequency::_40Mhz);
    let format = || {
        IdfBootloaderFormat::new(&bytes, &data, Some(Path::new(partitions)), None, None, None)
            .with_context(|| format!("{elf} with {partitions} makes no image"))
    };

    let mut whole = Vec::new();
    for segment in format()?.flash_segments() {
        let start = segment.addr as usize;
        if start < whole.len() {
            bail!(
                "the part at {start:#x} lies within the one before, which ends at {:#x}",
                whole.len()
            );
        }
        // Erased flash in between.
        whole.resize(start, 0xFF);
        whole.extend_from_slice(segment.data());
    }
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
    Ok(())
}
