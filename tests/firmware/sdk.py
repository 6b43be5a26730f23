"""Creates a folder that replaces the vendor's SDK, so that the ESP8266's image can be linked for every change: the
headers of sdk/, a library with every function they declare (each returns at once), and as much memory as the SDK uses
on the chip.

    sdk.py FOLDER
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
# Sizes that sdk/link reports for SDK 3.0.5. The data RAM's size is in the emulator's map.
INSTRUCTION_RAM, FLASH = 25_838, 204_000
MAP = HERE / "../../firmware-esp/esp8266/qemu/link.ld"
# Libraries that the link names in addition to the one with all functions.
EMPTY = ["net80211", "pp", "phy", "wpa", "crypto", "lwip", "hal"]
# Functions of the application called by the SDK; and functions of the SDK and the ROM that are not in its headers.
CALLED = ["user_pre_init", "user_init", "memchr", "__ctype_ptr__"]
OTHERS = ["load_non_32_wide_handler", "eagle_lwip_getif", "__udivsi3"]


def functions():
    """Returns the names of all functions declared in the headers."""
    names = set(OTHERS)
    for header in sorted(HERE.glob("sdk/**/*.h")):
        for line in header.read_text().splitlines():
            found = re.match(r"(?!typedef|#|struct \w+ \{)[\w ]+[ *](\w+)\(.*\);$", line)
            if found:
                names.add(found[1])
    return sorted(names)


def assembly():
    """Returns the library's source."""
    data = int(re.search(r"_sdk_bytes = (\d+);", MAP.read_text())[1])
    lines = [".section .entry.text, \"ax\"", ".align 4", ".literal_position",
             ".global call_user_start", "call_user_start:"]
    for name in [*CALLED, "sdk_data", "sdk_code", "sdk_flash"]:
        lines += [f"movi a2, {name}", "callx0 a2"]
    lines += [".section .irom0.text, \"ax\"", ".align 4"]
    for name in functions():
        lines += [f".global {name}", f"{name}:", "ret"]
    lines += [".align 4", f"sdk_flash: .space {FLASH}",
              ".section .text.sdk, \"ax\"", ".align 4", f"sdk_code: .space {INSTRUCTION_RAM}",
              ".section .bss, \"aw\", @nobits", ".align 8", f"sdk_data: .space {data}"]
    return "\n".join(lines) + "\n"


def main():
    folder = Path(sys.argv[1])
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(HERE / "sdk", folder)
    for name in ("lib", "bin"):
        (folder / name).mkdir()
    (folder / "sdk.S").write_text(assembly())
    cross = "xtensa-lx106-elf-"
    subprocess.run([cross + "gcc", "-c", "-mlongcalls", "-mtext-section-literals",
                    "-o", folder / "sdk.o", folder / "sdk.S"], check=True)
    for name in ["main", *EMPTY]:
        archive = folder / "lib" / f"lib{name}.a"
        subprocess.run([cross + "ar", "rc", archive, *([folder / "sdk.o"] if name == "main" else [])],
                       check=True)
    # Erased flash, with the length of the SDK's file.
    (folder / "bin/esp_init_data_default_v08.bin").write_bytes(b"\xff" * 128)
    (folder / "bin/blank.bin").write_bytes(b"\xff" * 4096)


if __name__ == "__main__":
    main()
