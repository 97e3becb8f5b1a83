"""README's moving picture: in-betweens of the sample hand and creature by torch_modal and linearly, with their volumes.

python docs/moving_picture.py
"""

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

import torch_modal as tm
from torch_modal.arrays import FloatArray, IntArray
from torch_modal.data.samples import load_sample
from torch_modal.geometry.inspect import volume_of
from torch_modal.motion.subdivide import keyframe_places
from torch_modal.times import fill_linear
from torch_modal.view.drawing import draw_image, plain
from torch_modal.view.picture import BETWEEN_COLOR, KEYFRAME_COLOR, view_rotation

FRAMES, PER_SECOND = 36, 16
ROWS = (("hand", (0, 1), 200), ("creature", (1, 3, 5), 180))
"""Samples, their key-frames that are given, and the heights of the rows in pixels."""
WIDTH, SMALL, LABEL = 270, 120, 18
"""Widths of the moving shapes and of the key-frames, and the height of a label, in pixels."""
LOST_COLOR, HALF_LOST = (0.78, 0.12, 0.14), 0.15
"""Colour of lost volume, and the part lost at which it is half mixed in."""


def draw(x: FloatArray, faces: IntArray, color: FloatArray, height: float, width: int, pixels: int) -> Image.Image:
    """A shape in view coordinates, as high as a row of this height."""
    half = 0.5 * height * np.array([width / pixels, 1.0])
    return Image.fromarray(
        draw_image(x, plain(np.broadcast_to(color, x.shape), faces), half, np.array([width, pixels]))
    )


def row(name: str, numbers: tuple[int, ...], pixels: int) -> list[Image.Image]:
    """One cycle of both, beside the key-frames."""
    sample = load_sample(name)
    keyframes, faces = sample.keyframes[list(numbers)].double(), sample.faces.numpy()
    # Two key-frames there and back again are a cycle too.
    own = tm.interpolate(keyframes, sample.faces, cyclic=True, smooth=len(keyframes) > 2, n_frames=FRAMES)
    places = keyframe_places(len(keyframes), 3, cyclic=True, n_frames=FRAMES)
    linear = fill_linear(keyframes, places)[:FRAMES]
    turn = torch.from_numpy(view_rotation(keyframes[0].numpy(), sample.view, None))
    every = torch.cat([own, linear, keyframes]) @ turn.mT
    low, high = every.flatten(0, 1).amin(0), every.flatten(0, 1).amax(0)
    extent = 1.04 * max(float((high - low)[1]), float((high - low)[0]) * pixels / WIDTH)
    middle = 0.5 * (low + high)
    font, given = ImageFont.load_default(13), Image.new("RGB", (SMALL, pixels), "white")

    def placed(x: Tensor) -> FloatArray:
        return (x @ turn.mT - middle).numpy()

    each = (pixels - LABEL) // len(keyframes)
    for i, x in enumerate(keyframes):
        small = draw(placed(x), faces, np.array(KEYFRAME_COLOR), extent, SMALL, each)
        given.paste(small, (0, LABEL + i * each))
    volume, images = abs(volume_of(keyframes[0].numpy(), faces)), []
    for i in range(FRAMES):
        image = Image.new("RGB", (SMALL + 2 * WIDTH, pixels), "white")
        image.paste(given, (0, 0))
        for k, (label, x) in enumerate((("torch_modal", own[i]), ("linear", linear[i]))):
            part = abs(volume_of(x.numpy(), faces)) / volume
            lost = 1 - 0.5 ** (max(0.0, 1 - part) / HALF_LOST)
            color = (1 - lost) * np.array(BETWEEN_COLOR) + lost * np.array(LOST_COLOR)
            left = SMALL + k * WIDTH
            image.paste(draw(placed(x), faces, color, extent, WIDTH, pixels), (left, 0))
            ImageDraw.Draw(image).text((left + 8, 4), f"{label}: volume {100 * part:.0f} %", "black", font)
        ImageDraw.Draw(image).text((8, 4), "given", "black", font)
        images.append(image)
    return images


def main(out: Path) -> None:
    """Draw all rows, one below the other."""
    rows = [row(*each) for each in ROWS]
    frames = []
    for images in zip(*rows, strict=True):
        frame = Image.new("RGB", (images[0].width, sum(image.height for image in images)), "white")
        top = 0
        for image in images:
            frame.paste(image, (0, top))
            top += image.height
        frames.append(frame.quantize(255, dither=Image.Dither.NONE))
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=1000 // PER_SECOND, loop=0, optimize=True)


if __name__ == "__main__":
    main(Path(__file__).parent / "images" / "moving.gif")
