"""Times gsplat on the output of `cargo bench --bench gpu -- --out FOLDER`, and prints it next to this project's
figures.

Usage: gsplat_times.py FOLDER

RGB+ED: colour and expected depth, with harmonics of degree 3; all cameras in one call. A call ends with colour, depth
and alpha copied to pinned host memory, as this project's renderer ends with images on the host.
"""

import json
import statistics
import sys
from pathlib import Path

import numpy as np


def load_ply(path):
    """Returns the columns of a binary PLY of floats, as written by this project, by name."""
    with path.open("rb") as file:
        names, count = [], 0
        while (line := file.readline().decode().strip()) != "end_header":
            words = line.split()
            if words[:2] == ["element", "vertex"]:
                count = int(words[2])
            elif words[0] == "property":
                assert words[1] == "float", line
                names.append(words[2])
        rows = np.fromfile(file, dtype="<f4").reshape(count, len(names))
    return {name: rows[:, i] for i, name in enumerate(names)}


def main():
    folder = Path(sys.argv[1])
    ours = json.loads((folder / "ours.json").read_text())
    try:
        import torch
        from gsplat import rasterization
    except ImportError as error:
        sys.exit(f"{error}; pip install torch gsplat")
    if not torch.cuda.is_available():
        sys.exit("gsplat needs CUDA, and torch finds none")

    def tensors(path):
        p = load_ply(path)
        column = lambda *names: np.stack([p[name] for name in names], axis=-1)
        rest = sum(name.startswith("f_rest_") for name in p) // 3
        dc = column("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
        others = column(*(f"f_rest_{i}" for i in range(3 * rest))).reshape(-1, 3, rest)
        arrays = {
            "means": column("x", "y", "z"),
            "quats": column("rot_0", "rot_1", "rot_2", "rot_3"),
            "scales": np.exp(column("scale_0", "scale_1", "scale_2")),
            "opacities": 1 / (1 + np.exp(-p["opacity"])),
            "colors": np.concatenate([dc, others.transpose(0, 2, 1)], axis=1),
        }
        to_device = lambda a: torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32)).cuda()
        return {name: to_device(array) for name, array in arrays.items()}

    print(f"{torch.cuda.get_device_name()}; ours on {ours['adapter']}\n")
    print("| scene | cameras | ours, ms | gsplat, ms | of it on the device | gsplat / ours |"
          " images/s, ours | gsplat | first image alike |")
    print("|" + "---|" * 9)
    scene, splats, cameras = None, None, None
    for row in ours["rows"]:
        path = folder / f"{row['scene']}.ply"
        if not path.exists():
            continue
        if scene != row["scene"]:
            scene, splats = row["scene"], tensors(path)
            cameras = json.loads(path.with_suffix(".json").read_text())
        seen = cameras[: row["cameras"]]
        width, height = seen[0]["w"], seen[0]["h"]
        k = [[[c["fx"], 0, c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1]] for c in seen]
        view = dict(
            viewmats=torch.tensor([c["w2c"] for c in seen], dtype=torch.float32).cuda(),
            Ks=torch.tensor(k, dtype=torch.float32).cuda(),
            width=width, height=height, near_plane=0.01, sh_degree=3, render_mode="RGB+ED",
        )
        host = torch.empty((len(seen), height, width, 5), pin_memory=True)

        @torch.no_grad()
        def call():
            start, drawn, copied = (torch.cuda.Event(enable_timing=True) for _ in range(3))
            start.record()
            image, alpha, _ = rasterization(**splats, **view)
            drawn.record()
            host[..., :4].copy_(image, non_blocking=True)
            host[..., 4:].copy_(alpha, non_blocking=True)
            copied.record()
            copied.synchronize()
            return start.elapsed_time(copied), start.elapsed_time(drawn)

        for _ in range(10):
            call()
        times = [call() for _ in range(100)]
        ms, device_ms = (statistics.median(column) for column in zip(*times))
        first = np.fromfile(path.with_suffix(".rgb"), dtype="<f4").reshape(height, width, 3)
        mean_square = np.mean((host[0, ..., :3].numpy() - first) ** 2)
        print(f"| {scene} | {len(seen)} | {row['call_ms']:.3f} | {ms:.3f} | {device_ms:.3f} |"
              f" {ms / row['call_ms']:.2f} | {row['images_per_s']:.0f} |"
              f" {len(seen) * 1e3 / ms:.0f} | {-10 * np.log10(mean_square):.1f} dB |")


if __name__ == "__main__":
    main()
