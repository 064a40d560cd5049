"""Where roll-outs begin and what is asked of the vehicles: the same scene can be played by any motion."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class Scene:
    """W worlds of K vehicles, each with G targets one after the other and O round obstacles, in the arena's frame.

    Attributes:
        start: (W, K, 3) x_mm, y_mm, heading_rad.
        targets: (W, G, 2) x_mm, y_mm in the order in which they are to be reached.
        obstacles: (W, O, 3) x_mm, y_mm, radius_mm.
        leg: (W,) index of the target that is sought now; all vehicles of a world seek the same.
    """

    start: np.ndarray
    targets: np.ndarray
    obstacles: np.ndarray
    leg: np.ndarray

    @classmethod
    def beginning(cls, start: np.ndarray, targets: np.ndarray, obstacles: np.ndarray | None = None) -> "Scene":
        """Return a scene in which every world seeks its first target; without `obstacles` there are none."""
        worlds = len(start)
        obstacles = np.empty((worlds, 0, 3)) if obstacles is None else obstacles
        return cls(start, targets, obstacles, np.zeros(worlds, dtype=int))

    @classmethod
    def joined(cls, scenes: Sequence["Scene"]) -> "Scene":
        """Return the worlds of several scenes side by side."""
        columns = {field.name: [getattr(scene, field.name) for scene in scenes] for field in fields(cls)}
        return cls(**{name: np.concatenate(parts) for name, parts in columns.items()})

    def __len__(self) -> int:
        return len(self.start)

    @property
    def target(self) -> np.ndarray:
        """The targets sought now, (W, 2)."""
        target: np.ndarray = self.targets[np.arange(len(self)), self.leg]
        return target

    @property
    def on_last_leg(self) -> np.ndarray:
        """Whether no further target follows, (W,)."""
        last: np.ndarray = self.leg == self.targets.shape[1] - 1
        return last

    def where(self, worlds: np.ndarray) -> "Scene":
        """Return some worlds: indices (n,) or a mask (W,)."""
        return Scene(**{field.name: getattr(self, field.name)[worlds] for field in fields(self)})

    def replaced(self, worlds: np.ndarray, other: "Scene") -> "Scene":
        """Return this scene with the worlds at indices (n,) taken from the n worlds of `other`."""

        def mixed(mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
            mine = mine.copy()
            mine[worlds] = theirs
            return mine

        return Scene(**{f.name: mixed(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)})

    def advanced(self, worlds: np.ndarray) -> "Scene":
        """Return this scene with the worlds of a mask (W,) seeking their next target, where there is one."""
        return replace(self, leg=self.leg + (worlds & ~self.on_last_leg))

    def from_first_leg(self) -> "Scene":
        """Return this scene with every world seeking its first target."""
        return replace(self, leg=np.zeros_like(self.leg))
