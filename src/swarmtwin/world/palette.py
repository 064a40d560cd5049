"""The colours of a world, the same in films and in figures."""

from functools import lru_cache

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED
from swarmtwin.world.shot import Status

VEHICLES = (FLOOR, "#d98e32", "#5f9470", "#8a6fa8", "#b5656b", "#5b7a99", "#a08a4f", "#4f9a9a")
TARGET = "#3f8f63"
OBSTACLE = "#8d99a6"
INK, FAINT, PAPER, GROUND, LINES = MEASURED, "#8a8a8a", "#f6f6f3", "#ffffff", "#ecece8"
ALARM = PREDICTED
STATUS = {
    Status.COLLIDED: ALARM,
    Status.LEFT_ARENA: ALARM,
    Status.REACHED: TARGET,
    Status.ON_THE_WAY: "#9aa0a6",
}


def vehicle_colour(index: int) -> str:
    """Return the colour of a vehicle."""
    return VEHICLES[index % len(VEHICLES)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour `#rrggbb`."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@lru_cache(maxsize=4096)
def blended(colour: str, share: float, background: str = GROUND) -> tuple[int, int, int]:
    """Return a share of a colour on a background, as red, green and blue."""
    red, green, blue = (
        round(share * over + (1 - share) * under) for over, under in zip(rgb(colour), rgb(background), strict=True)
    )
    return red, green, blue
