"""Checks a chip's images as its loaders read them: addresses of the parts, headers, checksums and hashes with the
vendor's esptool, free space for settings and updates.

    image.py esp32c3|esp8266 FOLDER
"""

import itertools
import re
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

FIRMWARE = Path(__file__).parent / "../../firmware-esp"
FLASH = 4 << 20
# ESP32-C3.
BOOTLOADER, TABLE, PROGRAM = 0x0000, 0x8000, 0x10000
# ESP8266: memory-mapped flash (read in place), settings of the core, data of the SDK.
MAPPED, SETTINGS, PHY_DATA, BLANK = 0x10000, 0x3F0000, 0x3FC000, 0x3FE000


def table_of(image):
    """Returns the partitions: name -> (type, subtype, start, length)."""
    parts = {}
    at = TABLE
    while image[at:at + 2] == b"\xaa\x50":
        kind, subtype, start, length = struct.unpack("<BBII", image[at + 2:at + 12])
        parts[image[at + 12:at + 28].rstrip(b"\0").decode()] = (kind, subtype, start, length)
        at += 32
    return parts


def info(chip, image, what, sums):
    """Checks an image and its number of checksums with esptool; returns esptool's output."""
    with tempfile.NamedTemporaryFile(suffix=".bin") as file:
        file.write(image)
        file.flush()
        checked = subprocess.run(
            [sys.executable, "-m", "esptool", "--chip", chip, "image-info", file.name],
            capture_output=True, text=True, check=False)
    good = checked.returncode == 0 and checked.stdout.count("(valid)") == sums
    assert good, f"esptool does not take {what}:\n{checked.stdout}{checked.stderr}"
    return checked.stdout


def esp32c3(folder):
    """Checks boot loader, partition table and program."""
    csv = FIRMWARE / "esp32c3/partitions.csv"
    image = (folder / "bridge-esp32c3.bin").read_bytes()
    update = (folder / "bridge-esp32c3-update.bin").read_bytes()
    parts = table_of(image)
    for line in csv.read_text().splitlines():
        fields = [field.strip() for field in line.split("#")[0].split(",")]
        if len(fields) >= 5:
            start, length = int(fields[3], 0), int(fields[4], 0)
            assert parts[fields[0]][2:] == (start, length), f"{fields[0]} is elsewhere"
    ends = sorted((start, start + length, name) for name, (_, _, start, length) in parts.items())
    for (_, end, name), (start, _, other) in itertools.pairwise(ends):
        assert end <= start, f"{name} reaches into {other}"
    assert ends[-1][1] <= FLASH, "more than the flash of 4 MB"
    first, second = parts["ota_0"], parts["ota_1"]
    assert first[2] == PROGRAM and first[3] == second[3] >= len(update) * 5 // 4, \
        "an update that has grown by a quarter must fit"
    assert image[PROGRAM:] == update, "the program differs from the update"
    info("esp32c3", image[BOOTLOADER:TABLE].rstrip(b"\xff"), "the bootloader", 2)
    info("esp32c3", update, "the program", 2)
    print(f"image of {len(image)} bytes, program {len(update)} of {first[3]}: as the chip wants it")


def esp8266(folder):
    """Checks the two parts of the program, the SDK's data, and that the emulator's memory map matches the chip's."""
    image = (folder / "bridge-esp8266.bin").read_bytes()
    update = (folder / "bridge-esp8266-update.bin").read_bytes()
    loaded = (folder / "part-0x00000.bin").read_bytes()
    mapped = (folder / "part-0x10000.bin").read_bytes()
    assert image[:len(update)] == update, "the program differs from the update"
    assert update[:MAPPED].rstrip(b"\xff") == loaded.rstrip(b"\xff"), "what is loaded is elsewhere"
    assert update[MAPPED:] == mapped, "what is read in place is elsewhere"
    assert len(update) <= SETTINGS and set(image[len(update):PHY_DATA]) == {0xFF}, \
        "something lies where the settings and the SDK's own go"
    assert len(image) == BLANK + 4096 <= FLASH and set(image[BLANK:]) == {0xFF}
    text = info("esp8266", image, "the image", 1)
    entry = int(re.search(r"Entry point: (0x\w+)", text)[1], 0)
    assert 0x40100000 <= entry < 0x40108000, f"it starts at {entry:#x}, which is no instruction RAM"
    taken = (folder / "memory.txt").read_text().splitlines()
    map_text = (FIRMWARE / "esp8266/qemu/link.ld").read_text()
    for name, pattern in (("_sdk_bytes", r"SDK (\d+)"), ("_around_bytes", r"around it (\d+)")):
        there = int(re.search(name + r" = (\d+);", map_text)[1])
        here = int(re.search(pattern, taken[0])[1])
        assert abs(there - here) <= 64, f"qemu/link.ld says {name} = {there}; on the chip it is {here}"
    print(f"image of {len(image)} bytes, program {len(update)}: as the chip wants it; {taken[0]}")


def main():
    chips = {"esp32c3": esp32c3, "esp8266": esp8266}
    chips[sys.argv[1]](Path(sys.argv[2]))


if __name__ == "__main__":
    main()
