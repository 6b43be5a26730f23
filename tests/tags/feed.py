"""A failing camera: plays a flight's images as YUV4MPEG2, later than they were exposed, with the faults of real
drivers.

Plays the flight forward and backward until the file END exists: a camera that is plugged in again starts this program,
which takes longer on a loaded machine than any recording, and the other camera must still run then.

Usage: feed.py FOLDER BEGIN_NS END [FAULT:FROM_S:TO_S ...]      faults: hang, repeat, dark, end; times of the first pass
"""

import itertools
import math
import pathlib
import sys
import time

import cv2
import numpy as np

SLOWER = 3
# Maximum number of passes; the test has ended by then.
WAYS = 20


def main() -> None:
    folder, begin_ns, ending = pathlib.Path(sys.argv[1]), int(sys.argv[2]), pathlib.Path(sys.argv[3])
    faults = [(word, float(start), float(end)) for word, start, end in (x.split(":") for x in sys.argv[4:])]
    lines = (folder / "stamps.csv").read_text().splitlines()[1:]
    stamps = [(name, int(stamp) / 1e9) for name, stamp in (line.split(",") for line in lines)]
    first_s = math.floor(stamps[0][1])
    # The same for all cameras.
    way_s = math.ceil(stamps[-1][1]) - first_s
    there = [(name, stamp_s - first_s) for name, stamp_s in stamps]
    # Without the first and last image, which would be shown twice.
    back = [(name, way_s - time_s) for name, time_s in there[-2:0:-1]]
    ways = itertools.islice(itertools.cycle((there, back)), WAYS)
    opened_s = (time.monotonic_ns() - begin_ns) / 1e9 / SLOWER
    image, headed = None, False
    for name, now_s in ((name, way * way_s + time_s) for way, images in enumerate(ways) for name, time_s in images):
        shown_ns = begin_ns + round(SLOWER * now_s * 1e9)
        wait_s = (shown_ns - time.monotonic_ns()) / 1e9
        if wait_s < 0:
            continue
        time.sleep(wait_s)
        if ending.exists():
            return
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
