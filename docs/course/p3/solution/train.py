#!/usr/bin/env python3
"""Project 3: trains the network that distinguishes the three windows, and writes it as ONNX.

    vizflyt dataset --project p3 --seed 500 --seeds 40 --images 1600 --size 160x120 --layers rgb,classes,instances \\
        --val 0 --gate-distance 0.8..8 --look-at-gate 0.9 --randomize my-p3/randomize.toml -o sets/p3-train
    vizflyt dataset --project p3 --seed 900 --seeds 4 --images 200 --size 160x120 --layers rgb,classes,instances \\
        --val 0 -o sets/p3-other
    pip install torch pillow onnx onnxscript
    python my-p3/train.py sets/p3-train sets/p3-other -o my-p3/windows.onnx

The network takes a batch of images (N, 120, 160, 3), colour from 0 to 255, and returns (N, 4, 120, 160): a number for
each pixel and class, 0 for the background, 1 to 3 for the windows in their order. The largest number is the result.
"""

from __future__ import annotations

import argparse
import itertools
import json
import pathlib
import time

import numpy as np
import onnx
import torch
from PIL import Image
from torch import Tensor, nn

WINDOWS = ("window 1", "window 2", "window 3")
# Channels at 80x60, 40x30, 20x15 and 10x8 pixels.
SIZES = (12, 16, 24, 32)


def load(folder: pathlib.Path) -> tuple[Tensor, Tensor]:
    """Returns images (N, H, W, 3) uint8, and the window of each pixel, (N, H, W), 0 for none."""
    images, masks = [], []
    for path in sorted((folder / "records").glob("*/*.json")):
        name = f"{path.parent.name}/{path.stem}.png"
        images.append(np.asarray(Image.open(folder / "images" / name)))
        instances = np.asarray(Image.open(folder / "instances" / name))
        mask = np.zeros(instances.shape, np.int64)
        for thing in json.loads(path.read_text())["things"]:
            if thing["name"] in WINDOWS:
                mask[instances == thing["id"]] = 1 + WINDOWS.index(thing["name"])
        masks.append(mask)
    if not images:
        raise SystemExit(f"no records/*/*.json in {folder}")
    return torch.from_numpy(np.stack(images)), torch.from_numpy(np.stack(masks))


def block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
        nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class WindowNet(nn.Module):
    """A small U-Net with three downsampling steps; input and output are blocks of 2 x 2 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.ModuleList(block(a, b) for a, b in zip((12, *SIZES), SIZES))
        self.up = nn.ModuleList(block(a + b, a) for a, b in itertools.pairwise(SIZES))
        self.last = nn.Conv2d(SIZES[0], 4 * (1 + len(WINDOWS)), 1)

    def forward(self, images: Tensor) -> Tensor:
        x = nn.functional.pixel_unshuffle(images.permute(0, 3, 1, 2) / 64.0 - 1.8, 2)
        kept = []
        for n, stage in enumerate(self.down):
            x = stage(x if n == 0 else nn.functional.max_pool2d(x, 2, ceil_mode=True))
            kept.append(x)
        for stage, beside in zip(reversed(self.up), reversed(kept[:-1])):
            wide = nn.functional.interpolate(x, size=beside.shape[2:], mode="nearest")
            x = stage(torch.cat([beside, wide], dim=1))
        return nn.functional.pixel_shuffle(self.last(x), 2)


def varied(images: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
    """Mirrors half of the images, and changes brightness, contrast and sharpness a little; 0 to 255."""
    flip = torch.rand(len(images)) < 0.5
    images = torch.where(flip[:, None, None, None], images.flip(2), images)
    masks = torch.where(flip[:, None, None], masks.flip(2), masks)
    gain = 1.0 + 0.3 * (torch.rand(len(images), 1, 1, 1) - 0.5)
    shift = 20.0 * (torch.rand(len(images), 1, 1, 1) - 0.5)
    noise = 4.0 * torch.rand(len(images), 1, 1, 1) * torch.randn(images.shape)
    return (images * gain + shift + noise).clamp(0, 255), masks


def loss_of(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross entropy, plus one minus Dice's coefficient of each window, which also works for small windows."""
    shares = logits.softmax(1)[:, 1:]
    true = nn.functional.one_hot(masks, logits.shape[1]).permute(0, 3, 1, 2)[:, 1:].float()
    dice = (2 * (shares * true).sum((0, 2, 3)) + 1) / (shares.sum((0, 2, 3)) + true.sum((0, 2, 3)) + 1)
    return nn.functional.cross_entropy(logits, masks) + 1 - dice.mean()


def score(network: nn.Module, images: Tensor, masks: Tensor) -> list[float]:
    """Returns the intersection over union of all pixels: of all windows together, then of each."""
    network.eval()
    both, either = np.zeros(1 + len(WINDOWS)), np.zeros(1 + len(WINDOWS))
    with torch.no_grad():
        for part, true in zip(images.split(32), masks.split(32)):
            found = network(part.float()).argmax(1)
            for n in range(1 + len(WINDOWS)):
                a, b = (found > 0, true > 0) if n == 0 else (found == n, true == n)
                both[n] += int((a & b).sum())
                either[n] += int((a | b).sum())
    return (both / np.maximum(either, 1)).tolist()


def write(network: nn.Module, path: pathlib.Path, rows: int, columns: int) -> None:
    """Writes ONNX with 16-bit weights; inference uses 32 bits."""
    network.eval()
    example = torch.zeros(1, rows, columns, 3)
    program = torch.onnx.export(
        network, (example,), input_names=["images"], output_names=["logits"], dynamo=True, verbose=False
    )
    model = program.model_proto
    for weights in list(model.graph.initializer):
        values = onnx.numpy_helper.to_array(weights)
        if values.dtype != np.float32 or values.size < 100:
            continue
        name = weights.name
        weights.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_16"))
        cast = onnx.helper.make_node("Cast", [f"{name}_16"], [name], to=onnx.TensorProto.FLOAT)
        model.graph.node.insert(0, cast)
    # Remove the source locations of nodes, which contain local paths.
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in [*model.graph.value_info, *model.graph.input, *model.graph.output, *model.graph.initializer]:
        del value.metadata_props[:]
    del model.graph.value_info[:]
    onnx.checker.check_model(model)
    onnx.save(model, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", type=pathlib.Path)
    parser.add_argument("others", type=pathlib.Path, nargs="*", help="other sets, to measure with")
    parser.add_argument("--epochs", type=int, default=16)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("-o", "--output", type=pathlib.Path, default=pathlib.Path("windows.onnx"))
    args = parser.parse_args()
    torch.manual_seed(1)
    images, masks = load(args.train)
    others = {folder.name: load(folder) for folder in args.others}
    network = WindowNet().to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=1e-4)
    batches = -(-len(images) // args.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=8e-3, total_steps=args.epochs * batches)
    print(f"{len(images)} images, {sum(weight.numel() for weight in network.parameters())} weights", flush=True)
    start = time.monotonic()
    for epoch in range(args.epochs):
        network.train()
        total = 0.0
        for batch in torch.randperm(len(images)).split(args.batch):
            shown, wanted = varied(images[batch].float(), masks[batch])
            loss = loss_of(network(shown), wanted)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
        figures = "".join(
            f"  {name} IoU " + " ".join(f"{share:.3f}" for share in score(network, *others[name])) for name in others
        )
        print(f"epoch {epoch + 1:2}  loss {total / batches:.3f}{figures}  {time.monotonic() - start:.0f} s", flush=True)
        if (epoch + 1) % 4 == 0 or epoch + 1 == args.epochs:
            write(network, args.output, *images.shape[1:3])


if __name__ == "__main__":
    main()
