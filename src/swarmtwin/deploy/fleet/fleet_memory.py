"""Memory that the processes of a fleet share: where each vehicle is, and what all of them are told.

Only the camera and other emulated vehicles may look at true poses here: whoever controls them sees pictures.
"""

import fcntl
import mmap
import os
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from swarmtwin.deploy.fleet.orders import Orders


class FleetMemory:
    """A file without a name that all processes of a fleet map. Each vehicle writes its own row; anybody reads all.

    A row holds a counter, odd while the row is being written, so that a reader recognises a torn one and reads again;
    of a writer that died amidst writing it keeps the row before. The motion over the time step that is under way stands
    in the row: a pose at any time within it follows.

    Attributes:
        vehicles: ids of the V vehicles, in the order of the rows.
        descriptor: of the file, to be inherited by the processes.
    """

    columns = (
        *("counter", "from_s", "from_x", "from_y", "from_heading", "to_s", "to_x", "to_y", "to_heading"),
        *("placed", "skipped_s", "heard"),
    )
    longest_command = 8
    orders_bytes = 1 << 18

    def __init__(self, vehicles: Sequence[str], descriptor: int | None = None) -> None:
        """Make the memory, or map that of another process by its file's descriptor."""
        self.vehicles = tuple(vehicles)
        width = len(self.columns) + self.longest_command
        rows_bytes = len(self.vehicles) * width * 8
        self._file: IO[bytes] | None = None
        if descriptor is None:
            folder = "/dev/shm" if Path("/dev/shm").is_dir() else None
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # it stays open as long as the fleet
            self._file.truncate(rows_bytes + self.orders_bytes)
            descriptor = self._file.fileno()
        self.descriptor = descriptor
        self._map = mmap.mmap(descriptor, rows_bytes + self.orders_bytes)
        self._rows = np.frombuffer(self._map, np.float64, len(self.vehicles) * width).reshape(len(self.vehicles), width)
        self._known = self._rows.copy()
        self._orders_at = rows_bytes
        self._writing = threading.Lock()
        self._reading = threading.Lock()

    def write(
        self,
        index: int,
        start: tuple[float, np.ndarray],
        end: tuple[float, np.ndarray],
        command: np.ndarray,
        placed: int,
        skipped_s: float,
        heard: int,
    ) -> None:
        """Write how a vehicle moves now.

        Args:
            index: of the vehicle's row.
            start: monotonic time and true pose (3,) at which the motion begins.
            end: and ends; after that the vehicle stands there until the next motion is written.
            command: (m,) that the actuators are told.
            placed: the number of the last placement that it has seen.
            skipped_s: for how long in all it was frozen.
            heard: commands that it has heard.
        """
        row = self._rows[index]
        row[0] += 1 if row[0] % 2 == 0 else 2
        row[1:9] = (start[0], *start[1], end[0], *end[1])
        row[9:12] = placed, skipped_s, heard
        row[12 : 12 + len(command)] = command
        row[0] += 1

    def read(self, tries: int = 50) -> np.ndarray:
        """Return all rows (V, columns and command), none torn; several threads of a process may read at once."""
        torn = np.ones(len(self.vehicles), bool)
        with self._reading:
            for _ in range(tries):
                before = self._rows[:, 0].copy()
                rows = self._rows.copy()
                whole = torn & (before == rows[:, 0]) & (before == self._rows[:, 0]) & (before % 2 == 0)
                self._known[whole] = rows[whole]
                torn &= ~whole
                if not torn.any():
                    break
            return self._known.copy()

    def poses(self, time_s: float) -> np.ndarray:
        """Return the true poses (V, 3) at a time on the monotonic clock, headings not wrapped."""
        rows = self.read()
        lasts_s = np.maximum(rows[:, 5] - rows[:, 1], 1e-9)
        share = np.clip((time_s - rows[:, 1]) / lasts_s, 0.0, 1.0)[:, None]
        pose: np.ndarray = rows[:, 2:5] + share * (rows[:, 6:9] - rows[:, 2:5])
        return pose

    def velocities(self, time_s: float) -> np.ndarray:
        """Return the true velocities (V, 3) at a time, in mm/s and rad/s in the arena's frame."""
        rows = self.read()
        moving = (time_s <= rows[:, 5]) & (rows[:, 5] > rows[:, 1])
        lasts_s = np.where(moving, rows[:, 5] - rows[:, 1], 1.0)[:, None]
        return np.where(moving[:, None], (rows[:, 6:9] - rows[:, 2:5]) / lasts_s, 0.0)

    def commands(self, length: int) -> np.ndarray:
        """Return what the vehicles' actuators are told, (V, m)."""
        return self.read()[:, 12 : 12 + length]

    def skipped_s(self) -> np.ndarray:
        """Return for how long in all each vehicle was frozen, (V,)."""
        return self.read()[:, 10]

    def heard(self) -> np.ndarray:
        """Return how many commands each vehicle has heard, (V,)."""
        return self.read()[:, 11]

    def have_placed(self, orders: Orders, vehicles: Collection[str]) -> bool:
        """Return whether some vehicles stand where the orders put them, or did."""
        seen = dict(zip(self.vehicles, self.read()[:, 9], strict=True))
        return all(seen[vehicle] >= orders.placement_number(vehicle) for vehicle in vehicles)

    @property
    def orders_number(self) -> int:
        """Counts the orders, to see cheaply whether there are others than before."""
        return int(struct.unpack_from("<Q", self._map, self._orders_at)[0])

    def orders(self, tries: int = 50) -> Orders | None:
        """Return the orders that hold; None where whoever writes them has not finished, or never will."""
        for _ in range(tries):
            number, length = struct.unpack_from("<QQ", self._map, self._orders_at)
            if number == 0:
                return Orders()
            begin = self._orders_at + 16
            content = bytes(self._map[begin : begin + length])
            if number % 2 == 0 and number == self.orders_number:
                return Orders.model_validate_json(content)
            time.sleep(0.0005)
        return None

    def change_orders(self, change: Callable[[Orders], Orders]) -> Orders:
        """Replace the orders by what `change` makes of them, one process at a time; return the new ones.

        Raises:
            UserError: they name a vehicle that there is not.
        """
        with self._writing:
            fcntl.lockf(self.descriptor, fcntl.LOCK_EX)
            try:
                number = self.orders_number | 1
                after = change(self.orders() or Orders())
                after.check(self.vehicles)
                content = after.model_dump_json().encode()
                if len(content) + 16 > self.orders_bytes:
                    raise ValueError("orders are too long")
                struct.pack_into("<Q", self._map, self._orders_at, number)
                struct.pack_into("<Q", self._map, self._orders_at + 8, len(content))
                begin = self._orders_at + 16
                self._map[begin : begin + len(content)] = content
                struct.pack_into("<Q", self._map, self._orders_at, number + 1)
                return after
            finally:
                fcntl.lockf(self.descriptor, fcntl.LOCK_UN)

    def close(self) -> None:
        """Let go of the file; the memory stays until nobody maps it."""
        if self._file is not None:
            self._file.close()
        else:
            os.close(self.descriptor)
