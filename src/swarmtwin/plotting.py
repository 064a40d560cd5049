"""How all pictures look: one style, one meaning for each colour."""

from contextlib import AbstractContextManager
from typing import Any

import matplotlib as mpl

MEASURED, PREDICTED, FLOOR = "#222222", "#d1495b", "#2e86ab"

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "figure.dpi": 120,
}


def style() -> AbstractContextManager[None]:
    """Return a context in which figures take the project's style."""
    return mpl.rc_context(STYLE)
