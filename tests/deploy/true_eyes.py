"""Eyes that need no camera: a fleet's true poses, with a camera's noise."""

import time

import numpy as np
from playground import MemoryCamera

from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.geometry import wrap_angle


class TrueTracker:
    """Sees the vehicles of a fleet where they were when a picture was taken, but for those hidden."""

    def __init__(self, memory, takes_s=0.004):
        self.memory = memory
        self.hidden = set()
        self._takes_s = takes_s
        self._rng = np.random.default_rng(1)

    def track(self, frame):
        time.sleep(self._takes_s)
        pose = self.memory.poses(frame.captured_s) + self._rng.normal(
            0, [0.1, 0.1, 0.002], (len(self.memory.vehicles), 3)
        )
        pose[:, 2] = wrap_angle(pose[:, 2])
        seen = {one: pose[index] for index, one in enumerate(self.memory.vehicles) if one not in self.hidden}
        return Sighting(frame.number, frame.captured_s, seen)


def see_by(memory):
    """Let `deploy` and `collect` see a fleet by its memory; return camera and tracker."""
    from swarmtwin.commands import collect, deploy
    from swarmtwin.studies.deployment_runner import Eyes

    camera, tracker = MemoryCamera(1 / 40), TrueTracker(memory)

    def open_eyes(*_):
        return Eyes(camera, tracker, None, {"source": "truth"})

    deploy.open_eyes = collect.open_eyes = open_eyes
    return camera, tracker
