"""How a scene is lit, and what the sensor adds."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

LightName = Literal["ordinary", "harsh"]


@dataclass(frozen=True)
class Light:
    """What becomes of brightness on its way to the sensor: brightness · gain + glare.

    Attributes:
        gain: (H, W) float32.
        glare: (H, W) float32, in grey levels.
    """

    gain: np.ndarray
    glare: np.ndarray

    def falls_on(self, scene: np.ndarray, rows: slice = slice(None), columns: slice = slice(None)) -> np.ndarray:
        """Return a part of the scene (h, w), any type, as it is seen, float32."""
        return scene * self.gain[rows, columns] + self.glare[rows, columns]


def light(name: LightName, size: tuple[int, int], rng: np.random.Generator) -> Light:
    """Return ordinary light, a little uneven; or a harsh one: a lamp at one side, a veil, and spots that dazzle.

    Args:
        name: of the light.
        size: width and height of the picture.
        rng: says where the lamp and the spots are.
    """
    width, height = size
    y, x = np.mgrid[-1 : 1 : complex(height), -1 : 1 : complex(width)].astype(np.float32)
    direction = rng.uniform(0, 2 * np.pi)
    ramp = x * np.float32(np.cos(direction)) + y * np.float32(np.sin(direction))
    if name == "ordinary":
        return Light(0.88 + 0.06 * ramp - 0.04 * (x**2 + y**2), np.zeros_like(ramp))
    glare = np.full_like(ramp, 45.0)
    for _ in range(3):
        centre = rng.uniform(-0.8, 0.8, 2)
        distance = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
        glare += rng.uniform(60, 160) * np.exp(-distance / np.float32(2 * 0.12**2))
    return Light(0.36 + 0.16 * ramp, glare)


class SensorNoise:
    """Noise of pixels: drawn beforehand, then shifted at random, as drawing it anew would take most of the time."""

    def __init__(self, size: tuple[int, int], deviation: float, rng: np.random.Generator, spare: int = 64) -> None:
        """Draw the noise.

        Args:
            size: width and height of the picture.
            deviation: standard deviation in grey levels.
            rng: to draw from.
            spare: how far it can be shifted.
        """
        self._size, self._spare, self._deviation = size, spare, deviation
        drawn = rng.standard_normal((2, size[1] + spare, size[0] + spare), np.float32) * np.float32(deviation)
        self._bank = drawn.round().astype(np.int16)

    def add(self, picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the picture (H, W) uint8 with noise, cut off at black and white."""
        if self._deviation == 0:
            return picture
        width, height = self._size
        which, row, column = rng.integers([2, self._spare, self._spare])
        noise = self._bank[which, row : row + height, column : column + width]
        return cv2.add(picture, noise, dtype=cv2.CV_8U)


def floor_pattern(size: tuple[int, int], rng: np.random.Generator, brightness: float = 130.0) -> np.ndarray:
    """Return a floor (H, W), uint8, that is not quite even, as wood or foam is not."""
    width, height = size
    coarse = rng.normal(0, 1, (max(2, height // 24), max(2, width // 24))).astype(np.float32)
    fine = rng.normal(0, 1, (max(2, height // 3), max(2, width // 3))).astype(np.float32)
    pattern: np.ndarray = 4.0 * cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    pattern = pattern + 3.0 * cv2.resize(fine, size, interpolation=cv2.INTER_LINEAR)
    return np.clip(brightness + pattern, 0, 255).astype(np.uint8)
