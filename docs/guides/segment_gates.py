"""Trains a small network that segments gates, on images of `vizflyt dataset` alone; says how well it does on others.

    vizflyt dataset --project p5 --seeds 20 --images 2000 --size 160x120 --layers rgb,classes --val 0 -o train
    vizflyt dataset --project p5 --seed 900 --seeds 4 --images 200 --size 160x120 --layers rgb,classes --val 0 -o race
    pip install torch numpy pillow
    python segment_gates.py train race

Both folders have `images` and `classes`; a pixel of class 2 is of a gate. Minutes on two cores, no graphics card.
"""

import argparse
import itertools
import pathlib
import time

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn

GATE = 2


def load(folder: pathlib.Path) -> tuple[Tensor, Tensor]:
    """Images N x 3 x H x W, 0 to 255, and where gates are, N x H x W."""
    paths = sorted((folder / "images").glob("*/*.png"))
    if not paths:
        raise SystemExit(f"no images/*/*.png in {folder}")
    images = np.stack([np.asarray(Image.open(path)) for path in paths])
    masks = np.stack([np.asarray(Image.open(folder / "classes" / path.parent.name / path.name)) for path in paths])
    return torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(), torch.from_numpy(masks == GATE)


def block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
        nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class SmallUNet(nn.Module):
    """Ronneberger et al. 2015, with few channels and three halvings; it sees and answers squares of 2 x 2 pixels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        sizes = [width, 2 * width, 4 * width, 8 * width]
        self.down = nn.ModuleList(block(a, b) for a, b in zip([12, *sizes], sizes))
        self.up = nn.ModuleList(block(a + b, a) for a, b in itertools.pairwise(sizes))
        self.last = nn.Conv2d(width, 4, 1)

    def forward(self, image: Tensor) -> Tensor:
        image = nn.functional.pixel_unshuffle(image, 2)
        kept = []
        for n, stage in enumerate(self.down):
            image = stage(image if n == 0 else nn.functional.max_pool2d(image, 2, ceil_mode=True))
            kept.append(image)
        for stage, beside in zip(reversed(self.up), reversed(kept[:-1])):
            wide = nn.functional.interpolate(image, size=beside.shape[2:], mode="nearest")
            image = stage(torch.cat([beside, wide], dim=1))
        return nn.functional.pixel_shuffle(self.last(image), 2).squeeze(1)


def prepared(images: Tensor) -> Tensor:
    return ((images.float() / 255.0 - 0.45) / 0.25).contiguous(memory_format=torch.channels_last)


def varied(images: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
    """Mirrors half of the images, and changes brightness and contrast a little."""
    flip = torch.rand(len(images)) < 0.5
    images = torch.where(flip[:, None, None, None], images.flip(-1), images)
    masks = torch.where(flip[:, None, None], masks.flip(-1), masks)
    gain = 1.0 + 0.3 * (torch.rand(len(images), 1, 1, 1) - 0.5)
    shift = 0.3 * (torch.rand(len(images), 1, 1, 1) - 0.5)
    return images * gain + shift, masks


def loss_of(logits: Tensor, masks: Tensor) -> Tensor:
    """Cross entropy, and one minus Dice's coefficient, which sees few pixels too."""
    masks = masks.float()
    share = torch.sigmoid(logits)
    dice = (2 * (share * masks).sum() + 1) / (share.sum() + masks.sum() + 1)
    return nn.functional.binary_cross_entropy_with_logits(logits, masks) + 1 - dice


def score(network: nn.Module, images: Tensor, masks: Tensor) -> tuple[float, float]:
    """Intersection over union of all pixels, and its mean over images with a gate of 50 pixels or more."""
    network.eval()
    both, either, of_images = 0, 0, []
    with torch.no_grad():
        for start in range(0, len(images), 32):
            found = network(prepared(images[start : start + 32])) > 0
            true = masks[start : start + 32]
            intersection, union = (found & true).sum(dim=(1, 2)), (found | true).sum(dim=(1, 2))
            both, either = both + int(intersection.sum()), either + int(union.sum())
            is_seen = true.sum(dim=(1, 2)) >= 50
            of_images += (intersection[is_seen] / union[is_seen]).tolist()
    return both / max(either, 1), float(np.mean(of_images))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", type=pathlib.Path)
    parser.add_argument("test", type=pathlib.Path)
    parser.add_argument("--epochs", type=int, default=22)
    parser.add_argument("--width", type=int, default=16, help="channels of the first stage")
    parser.add_argument("--batch", type=int, default=16)
    args = parser.parse_args()
    torch.manual_seed(1)
    images, masks = load(args.train)
    others, true = load(args.test)
    # Channels last: processors convolve them faster.
    network = SmallUNet(args.width).to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=1e-4)
    batches = -(-len(images) // args.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=6e-3, total_steps=args.epochs * batches)
    weights = sum(weight.numel() for weight in network.parameters())
    print(f"{len(images)} images to train with, {len(others)} others, {weights} weights")
    start = time.monotonic()
    for epoch in range(args.epochs):
        network.train()
        total = 0.0
        for batch in torch.randperm(len(images)).split(args.batch):
            shown, wanted = varied(prepared(images[batch]), masks[batch])
            loss = loss_of(network(shown), wanted)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
        overall, mean = score(network, others, true)
        spent = time.monotonic() - start
        figures = f"loss {total / batches:.3f}  IoU {overall:.4f}, mean of images {mean:.4f}"
        print(f"epoch {epoch + 1:2}  {figures}  {spent:.0f} s", flush=True)


if __name__ == "__main__":
    main()
