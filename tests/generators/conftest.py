import pytest
from plant import config, planted, preparation

from swarmtwin.generators.generator_folder import Lineage
from swarmtwin.generators.training import fit


@pytest.fixture(scope="session")
def real(robots):
    """Real transitions of an MGR of which everything is known."""
    return planted(robots["mgr"])


class TrainedWhenAsked(dict):
    """Shipped generators by name, each trained quickly on the same transitions when it is first asked for."""

    def __init__(self, real):
        super().__init__()
        self.real = real

    def __missing__(self, name):
        self[name] = fit(self.real, config(name), seed=1)[0]
        return self[name]


@pytest.fixture(scope="session")
def trained(real):
    """Every shipped generator, trained on them quickly, by name."""
    return TrainedWhenAsked(real)


@pytest.fixture(scope="session")
def lineage(real):
    """Where they come from."""
    return Lineage.of(preparation(real), real, seed=1)
