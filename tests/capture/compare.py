"""Films a generated hall, captures it, and compares the twin with the true scene.

    python compare.py VIZFLYT [--replay] [FOLDER]

--replay takes recorded poses of the film, which pycolmap computed once; otherwise pycolmap computes new ones, which
vary from run to run. FOLDER, if given, keeps the files. The bounds are those of a metric twin: 95 % of the pictures
placed, scale within 0.3 %, up within 0.2 degrees, camera centres within 2 cm; half a centimetre more with a fifth of
the pictures, sampled at a fixed rate.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

passed = failed = 0


def check(what: str, good: bool) -> None:
    global passed, failed
    passed, failed = passed + good, failed + (not good)
    print(f"{'ok  ' if good else 'FAIL'} {what}", flush=True)


def run(vizflyt: str, *args: str, cwd: Path) -> tuple[int, str]:
    start = time.monotonic()
    done = subprocess.run([vizflyt, *args], cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    print(f"$ vizflyt {' '.join(args)}  ({time.monotonic() - start:.0f} s)\n{done.stdout}", flush=True)
    return done.returncode, done.stdout


def similarity(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns scale, rotation and translation that fit `found` to `true`, N x 3 each (Umeyama 1991)."""
    mean_found, mean_true = found.mean(0), true.mean(0)
    left, values, right = np.linalg.svd((true - mean_true).T @ (found - mean_found))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ np.diag(signs) @ right
    scale = (values * signs).sum() / ((found - mean_found) ** 2).sum()
    return scale, rotation, mean_true - scale * rotation @ mean_found


def compare(capture: dict, truth: dict) -> dict[str, float]:
    """Returns the errors of the pictures' positions, before and after alignment."""
    way = capture["metric"]["way"]
    found = np.array([placed["position_m"] for placed in way])
    frames = [round(placed["at_s"] * RATE_HZ) for placed in way]
    true = np.array([truth["images"][frame]["world_from_cam"]["position_m"] for frame in frames])
    scale, rotation, translation = similarity(found, true)
    aligned = found @ (scale * rotation).T + translation

    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt((difference**2).sum(1).mean()))

    return {
        "placed": len(way) / len(capture["pictures"]["pictures"]),
        "off_m": rms(found - true),
        "aligned_m": rms(aligned - true),
        "scale": abs(1 / scale - 1),
        "up_deg": float(np.degrees(np.arccos(min(1.0, rotation[2, 2])))),
    }


def main(vizflyt: str, home: Path) -> None:
    vizflyt = str(Path(vizflyt).resolve())
    # Renders a fifth of the video's pictures, in a fifth of the time.
    film = ["scene", "generate", "room", "--seed", "3", "--tags", "--capture", "film", "--frames", str(FRAMES)]
    code, _ = run(vizflyt, *film, cwd=home)
    check("a hall is filmed", code == 0)
    encode = ["ffmpeg", "-nostdin", "-v", "error", "-y", "-framerate", str(RATE_HZ), "-i", "film/%05d.jpg"]
    subprocess.run([*encode, "-c:v", "libx264", "-crf", "14", "-pix_fmt", "yuv420p", "hall.mp4"], cwd=home, check=True)
    truth = json.loads((home / "film/truth.json").read_text())
    small = ["--python", sys.executable, "--steps", "60", "--splats", "5000", "--width", "160"]
    capture = ["scene", "capture", "hall.mp4", "-o", "hall", "--camera", "film/camera.toml", *small]

    # Pictures at a fixed rate are more blurred than the sharpest ones, and may be refused: only the accuracy of their
    # positions is tested.
    run(vizflyt, *capture, "--tags", "film/tags.toml", "--force", cwd=home)
    made = json.loads((home / "hall/capture.json").read_text())
    check("it is captured", bool(made["finished"]) and (home / "hall/arena.toml").is_file())
    off = compare(made, truth)
    print(off)
    check(f"{100 * off['placed']:.1f} % of the pictures are placed", off["placed"] >= 0.95)
    check(f"camera centres are off by {100 * off['off_m']:.2f} cm in the room", off["off_m"] <= 0.025)
    check(f"the scale is off by {100 * off['scale']:.3f} %", off["scale"] <= 0.003)
    check(f"up is off by {off['up_deg']:.3f} degrees", off["up_deg"] <= 0.2)
    bound = made["metric"]["scale_bound"]
    check(f"the scale's bound of {100 * bound:.2f} % holds", off["scale"] <= bound)
    fence = made["finished"]
    inside = [
        all(low < p < high for low, p, high in zip(fence["fence_min_m"], placed["position_m"], fence["fence_max_m"]))
        for placed in made["metric"]["way"]
    ]
    check("the walk is within the fence", all(inside))

    _, said = run(vizflyt, *capture, "--tags", "film/tags.toml", "--force", cwd=home)
    check("again, all is kept", said.count("(kept)") == 6)

    # The same pictures and poses, without measured positions of the tags.
    _, said = run(vizflyt, *capture, "--tag-size", "0.24", "--force", cwd=home)
    by_size = json.loads((home / "hall/capture.json").read_text())
    off = compare(by_size, truth)
    check("poses are kept where only the room's measures change", said.count("(kept)") == 3)
    # Blur moves the corners of a small tag towards its centre; the bound includes this.
    bound = by_size["metric"]["scale_bound"]
    what = f"by the tags' size alone the scale is off by {100 * off['scale']:.2f} %, {100 * bound:.2f} at most"
    check(what, off["scale"] <= bound <= 0.03)
    check(f"by the floor up is off by {off['up_deg']:.3f} degrees", off["up_deg"] <= 0.5)

    code, said = run(vizflyt, *capture, cwd=home)
    guessed = json.loads((home / "hall/capture.json").read_text())
    check("without any measure the scale is guessed, and said to be", guessed["metric"]["scale_is_guessed"])
    check("and it is refused", code != 0 and "REFUSED" in said and not (home / "hall/arena.toml").exists())


# For a walk of 50 s: two frames for each picture taken.
FRAMES, RATE_HZ = 300, 6

if __name__ == "__main__":
    if "--replay" in sys.argv:
        sys.argv.remove("--replay")
        os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parent / "replay")
        os.environ["FILM_RATE_HZ"] = str(RATE_HZ)
    if len(sys.argv) > 2:
        Path(sys.argv[2]).mkdir(parents=True, exist_ok=True)
        main(sys.argv[1], Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(sys.argv[1], Path(folder))
    print(f"{passed} of {passed + failed} comparisons passed")
    sys.exit(failed > 0)
