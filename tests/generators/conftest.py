import pytest
from plant import config, planted, preparation

from swarmtwin.generators.generator_folder import Lineage
from swarmtwin.generators.training import fit


@pytest.fixture(scope="session")
def real(robots):
    """Real transitions of an MGR of which everything is known."""
    return planted(robots["mgr"])


@pytest.fixture(scope="session")
def trained(real):
    """Both generators, trained on them, by name."""
    return {name: fit(real, config(name), seed=1)[0] for name in ("residual_diffusion", "gan")}


@pytest.fixture(scope="session")
def lineage(real):
    """Where they come from."""
    return Lineage.of(preparation(real), real, seed=1)
