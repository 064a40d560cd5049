"""Films of roll-outs: several of them from the same start side by side, as H.264 that every browser plays."""

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

import av
import numpy as np

from swarmtwin.files import whole_file
from swarmtwin.world.rendering import draw, side_by_side
from swarmtwin.world.rollout import Rollout
from swarmtwin.world.shot import shot_of

FRAMES_PER_S = 24
LINGER_S = 1.5
CODEC_OPTIONS = {"crf": "20", "preset": "veryfast"}


def frames(rollouts: Mapping[str, Rollout], world: int, speed: float = 4.0) -> Iterator[np.ndarray]:
    """Draw one world of each roll-out, all from the same start, until the last of them has ended.

    Args:
        rollouts: by the title of what moved the vehicles.
        world: which of their worlds.
        speed: how many seconds pass in one second of the film.

    Yields:
        (height, width, 3) uint8 pictures, `FRAMES_PER_S` a second.
    """
    duration_s = max(rollout.periods[world] * rollout.robot.period_s for rollout in rollouts.values())
    moving, lingering = math.ceil(duration_s / speed * FRAMES_PER_S), round(LINGER_S * FRAMES_PER_S)
    picture = np.empty(0)
    for index in range(moving + 1):
        time_s = min(index * speed / FRAMES_PER_S, duration_s)
        shots = [shot_of(run, world, time_s / run.robot.period_s, title) for title, run in rollouts.items()]
        picture = side_by_side([draw(shot) for shot in shots])
        yield picture
    for _ in range(lingering):
        yield picture


def write_film(path: Path, pictures: Iterable[np.ndarray], frames_per_s: int = FRAMES_PER_S) -> None:
    """Write pictures (height, width, 3) of one even size as a film, whole or not at all.

    Raises:
        ValueError: there are no pictures, or their size is odd.
    """
    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None or any(size % 2 for size in first.shape[:2]):
        raise ValueError("a film needs pictures of an even width and height")
    with whole_file(path) as aside:
        _encode(aside, first, pictures, frames_per_s)


def _encode(path: Path, first: np.ndarray, others: Iterator[np.ndarray], frames_per_s: int) -> None:
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=frames_per_s, options=CODEC_OPTIONS)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in chain([first], others):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
