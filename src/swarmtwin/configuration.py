"""Where `conf/` is: the configuration that comes with swarmtwin."""

from pathlib import Path


def config_folder() -> Path:
    """Return `conf/`: inside the installed package, or at the top of the repository it is developed in."""
    package = Path(__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parents[1] / "conf"
