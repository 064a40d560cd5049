"""Turn the film of a roll-out into the picture at the top of the README: `film_to_gif.py rollout.mp4 group.gif`."""

import argparse
from itertools import islice
from pathlib import Path
from typing import cast

import av
from PIL import Image


def gif_frames(film: Path, width: int, every: int, last: int) -> list[Image.Image]:
    """Read frames of a film, made smaller, in the colours of the last of them.

    Args:
        film: an MP4.
        width: of the frames, in pixels.
        every: of how many frames one is taken.
        last: number of the film's frames that are looked at.
    """
    with av.open(str(film)) as file:
        images = [frame.to_image() for frame in islice(file.decode(video=0), 0, last, every)]
    height = round(images[0].height * width / images[0].width)
    small = [image.resize((width, height), Image.Resampling.LANCZOS) for image in images]
    palette = palette_of(small[-1])
    return [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in small]


def palette_of(image: Image.Image, frequent: int = 16, others: int = 56) -> Image.Image:
    """Return an image with a palette: the most frequent colours as they are, and a selection from all that occur."""
    counted = cast(list[tuple[int, tuple[int, int, int]]], image.getcolors(image.width * image.height) or [])
    colours = [colour for _, colour in sorted(counted, reverse=True)]
    occurring = Image.new("RGB", (len(colours), 1))
    occurring.putdata(colours)
    selected = occurring.quantize(others).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for colour in colours[:frequent] for part in colour] + selected[: 3 * others])
    return palette


def main() -> None:
    """Write the GIF."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("film", type=Path)
    parser.add_argument("gif", type=Path)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--every", type=int, default=3)
    parser.add_argument("--last", type=int, default=106)
    options = parser.parse_args()
    frames = gif_frames(options.film, options.width, options.every, options.last)
    durations_ms = [1000 * options.every // 24] * (len(frames) - 1) + [2000]
    frames[0].save(options.gif, save_all=True, append_images=frames[1:], duration=durations_ms, loop=0, optimize=True)


if __name__ == "__main__":
    main()
