"""A camera that fails: plays a flight's images as YUV4MPEG2, slower than they were exposed, and does what drivers do.

Usage: feed.py FOLDER BEGIN_NS [FAULT:FROM_S:TO_S ...]      faults: hang, repeat, dark, end; times of the recording
"""

import pathlib
import sys
import time

import cv2
import numpy as np

# A camera that is plugged in again starts this program: on a loaded machine that takes seconds, which the other camera
# must still be there for.
SLOWER = 3


def main() -> None:
    folder, begin_ns = pathlib.Path(sys.argv[1]), int(sys.argv[2])
    faults = [(word, float(start), float(end)) for word, start, end in (x.split(":") for x in sys.argv[3:])]
    lines = (folder / "stamps.csv").read_text().splitlines()[1:]
    stamps = [(name, int(stamp)) for name, stamp in (line.split(",") for line in lines)]
    first_ns = stamps[0][1] // 10**9 * 10**9
    opened_s = (time.monotonic_ns() - begin_ns) / 1e9 / SLOWER
    image, headed = None, False
    for name, stamp_ns in stamps:
        now_s = (stamp_ns - first_ns) / 1e9
        shown_ns = begin_ns + SLOWER * (stamp_ns - first_ns)
        wait_s = (shown_ns - time.monotonic_ns()) / 1e9
        if wait_s < 0:
            continue
        time.sleep(wait_s)
        fault = next((word for word, start, end in faults if start <= now_s < end), "")
        if fault == "end" and opened_s < now_s - 0.2:
            raise SystemExit("the camera was unplugged")
        if fault == "hang":
            continue
        if fault != "repeat" or image is None:
            image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
        shown = np.full_like(image, 4) if fault == "dark" else image
        if not headed:
            headed = True
            height, width = image.shape
            sys.stdout.buffer.write(b"YUV4MPEG2 W%d H%d F30:1 Cmono\n" % (width, height))
        sys.stdout.buffer.write(b"FRAME XSTAMP_NS=%d\n" % shown_ns)
        sys.stdout.buffer.write(shown.tobytes())
        sys.stdout.buffer.flush()


main()
