"""Checks the ESP32-C3's image as the chip's loaders read it: parts where they look for them, headers,
checksums and hashes by the vendor's esptool, room for settings and updates.

    image.py FOLDER PARTITIONS.csv
"""

import itertools
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

BOOTLOADER, TABLE, PROGRAM = 0x0000, 0x8000, 0x10000


def table_of(image):
    """Returns the partitions: name -> (type, subtype, start, length)."""
    parts = {}
    at = TABLE
    while image[at:at + 2] == b"\xaa\x50":
        kind, subtype, start, length = struct.unpack("<BBII", image[at + 2:at + 12])
        parts[image[at + 12:at + 28].rstrip(b"\0").decode()] = (kind, subtype, start, length)
        at += 32
    return parts


def valid(image, what):
    """Lets esptool judge an image."""
    with tempfile.NamedTemporaryFile(suffix=".bin") as file:
        file.write(image)
        file.flush()
        checked = subprocess.run(
            [sys.executable, "-m", "esptool", "--chip", "esp32c3", "image-info", file.name],
            capture_output=True, text=True, check=False)
    good = checked.returncode == 0 and checked.stdout.count("(valid)") == 2
    assert good, f"esptool does not take {what}:\n{checked.stdout}{checked.stderr}"


def main():
    folder, csv = Path(sys.argv[1]), Path(sys.argv[2])
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
    assert ends[-1][1] <= 4 << 20, "more than the flash of 4 MB"
    first, second = parts["ota_0"], parts["ota_1"]
    assert first[2] == PROGRAM and first[3] == second[3] >= len(update) * 5 // 4, \
        "an update that has grown by a quarter must fit"
    assert image[PROGRAM:] == update, "the program differs from the update"
    valid(image[BOOTLOADER:TABLE].rstrip(b"\xff"), "the bootloader")
    valid(update, "the program")
    print(f"image of {len(image)} bytes, program {len(update)} of {first[3]}: as the chip wants it")


if __name__ == "__main__":
    main()
