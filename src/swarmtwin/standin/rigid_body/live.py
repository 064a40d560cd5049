"""Vehicles of the rigid-body engine, driven live."""

import numpy as np

from swarmtwin.standin.live import LiveStandIns
from swarmtwin.standin.physics import Period
from swarmtwin.standin.rigid_body.driving import machine_of, photographed


class LiveRigidVehicles(LiveStandIns):
    """Vehicles that the engine moves, as it does in sessions that are recorded; effects refused there are here."""

    purpose = "rigid body"

    def _switched_on(self, pose: np.ndarray) -> np.ndarray:
        self._machine = machine_of(self._session)
        self.resting_command = self._machine.resting_command
        return self._machine.put(pose)

    def _put_back(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        return self._machine.put_back(worlds, pose)

    def _advanced(self, period: Period) -> np.ndarray:
        groups, vehicles = self._state.shape[1:]
        shape = (groups, self._machine.pieces, self._machine.noises, vehicles)
        noise = self._streams.of("motion").standard_normal(shape, np.float32)
        return self._machine.advance(self._state, period, noise.transpose(1, 2, 0, 3))

    def _photographed(self, pose: np.ndarray) -> np.ndarray:
        return photographed(self._session, self._machine, pose, self._streams)
