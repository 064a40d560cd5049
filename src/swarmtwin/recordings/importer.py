"""What an importer is: it reads foreign data, wherever they come from, as the tracks of a recording."""

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path

from swarmtwin.plugins import PluginRegistry
from swarmtwin.recordings import importers
from swarmtwin.recordings.recording import Header, Sent, Track
from swarmtwin.robot import Robot, StrictModel


class ImporterConfig(StrictModel):
    """The configuration of an importer, as in its `conf/source/<name>.yaml`.

    Attributes:
        name: the source's name, that of its file.
    """

    name: str

    @abstractmethod
    def read(
        self, folder: Path, robot: Robot, vehicles: Sequence[str] | None, run_s: float
    ) -> tuple[Header, list[Track]]:
        """Read a data set at the robot's period, cut into runs.

        Args:
            folder: where the data lie.
            robot: whose data they are.
            vehicles: ids of those to read; None for all there are.
            run_s: length of a run.

        Raises:
            UserError: data are missing or damaged, or of another robot.
        """

    def sent(self, folder: Path, robot: Robot, vehicles: Sequence[str] | None) -> Sent | None:
        """Return every command at the time it was sent, on the clock of `read`; None where tracks say all.

        Raises:
            UserError: data are missing or damaged.
        """
        return None


IMPORTERS: PluginRegistry[ImporterConfig] = PluginRegistry(importers, "source", group="source")

importer_config = IMPORTERS.config
