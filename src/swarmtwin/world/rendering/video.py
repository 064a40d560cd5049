"""Videos of roll-outs: several of them from the same start side by side, as H.264 that every browser plays."""

import math
import platform
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

import av
import cv2
import numpy as np

from swarmtwin.files import whole_file
from swarmtwin.world.rendering.drawing import draw, side_by_side
from swarmtwin.world.rendering.frame import frame_of
from swarmtwin.world.rollout import Rollout


def pictures(
    rollouts: Mapping[str, Rollout], world: int, speed: float = 4.0, frames_per_s: int = 24, linger_s: float = 1.5
) -> Iterator[np.ndarray]:
    """Draw one world of each roll-out, all from the same start, until the last of them has ended.

    Args:
        rollouts: by the title of what moved the vehicles.
        world: which of their worlds.
        speed: how many seconds pass in one second of the video.
        frames_per_s: pictures a second.
        linger_s: how long the last picture stays.

    Yields:
        (height, width, 3) uint8 pictures.
    """
    duration_s = max(rollout.periods[world] * rollout.robot.period_s for rollout in rollouts.values())
    picture = np.empty(0)
    for index in range(math.ceil(duration_s / speed * frames_per_s) + 1):
        time_s = min(index * speed / frames_per_s, duration_s)
        frames = [frame_of(run, world, time_s / run.robot.period_s, title) for title, run in rollouts.items()]
        picture = side_by_side([draw(frame) for frame in frames])
        yield picture
    for _ in range(round(linger_s * frames_per_s)):
        yield picture


def write_video(
    path: Path, images: Iterable[np.ndarray], frames_per_s: int = 24, constant_rate_factor: int = 20
) -> None:
    """Write pictures (height, width, 3) uint8 of one even size as a video, whole or not at all.

    The same pictures give the same bytes: one thread, and colours converted by OpenCV, since FFmpeg's conversion leaves
    its rows' padding undefined, on which the encoder's decisions then depend. For the same reason x264 is kept from its
    newest instructions, whose code looks beyond the end of rows that are no multiple of 64.

    Raises:
        ValueError: there are no pictures, or their size is odd.
    """
    images = iter(images)
    first = next(images, None)
    if first is None or any(size % 2 for size in first.shape[:2]):
        raise ValueError("a video needs pictures of an even width and height")
    with whole_file(path) as aside, av.open(str(aside), "w", format="mp4", options={"movflags": "+faststart"}) as file:
        options = {"crf": str(constant_rate_factor), "preset": "veryfast"}
        if platform.machine().lower() in ("x86_64", "amd64"):
            options["x264-params"] = "asm=sse4.2"  # which every such machine has that NumPy runs on
        stream = file.add_stream("libx264", rate=frames_per_s, options=options)
        stream.codec_context.thread_count = 1
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in chain([first], images):
            planes = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuv420p")))
        file.mux(stream.encode(None))
