"""What every generator's configuration has in common; each generator file ends in its own kind of it."""

from abc import abstractmethod
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from swarmtwin.robot import Robot, StrictModel

if TYPE_CHECKING:
    from swarmtwin.generators.base import Generator

Steps = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=2)]


class GeneratorConfig(StrictModel):
    """The configuration of a generator, as in its `conf/generator/<name>.yaml`.

    Attributes:
        name: the generator's name, that of its file.
    """

    name: str

    @property
    @abstractmethod
    def training_steps(self) -> int:
        """How many steps its whole training takes."""

    @abstractmethod
    def build(self, robot: Robot) -> "Generator":
        """Build the generator, untrained."""
