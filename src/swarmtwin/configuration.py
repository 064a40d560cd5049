"""Where configurations lie: `conf/`, which comes with swarmtwin, and those beside the user's own plug-ins."""

from pathlib import Path

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from swarmtwin.plugins import plugin_folders


def config_folder() -> Path:
    """Return `conf/`: that of the pipeline in the working folder, else the package's, or that of its repository.

    DVC runs queued experiments in copies of the repository, whose `conf/` holds their parameters.
    """
    here = Path.cwd()
    if (here / "dvc.yaml").is_file() and (here / "conf" / "pipeline.yaml").is_file():
        return here / "conf"
    package = Path(__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parents[1] / "conf"


def config_folders() -> tuple[Path, ...]:
    """Return `conf/`, and that of each folder in `SWARMTWIN_PLUGINS` that holds one; the earlier go first."""
    return (config_folder(), *(folder / "conf" for folder in plugin_folders() if (folder / "conf").is_dir()))


def config_files(group: str) -> dict[str, Path]:
    """Return the files of a folder in `conf/`, here and beside the user's plug-ins, by the name that chooses each."""
    files = (file for folder in reversed(config_folders()) for file in sorted((folder / group).glob("*.yaml")))
    return {file.stem: file for file in files}


class PluginConfigs(SearchPathPlugin):
    """Lets Hydra look beside the user's plug-ins as well, after `conf/` and --config-dir."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the `conf/` of each folder of plug-ins."""
        for folder in config_folders()[1:]:
            search_path.append("swarmtwin plug-ins", f"file://{folder}")


def let_hydra_find_plugins() -> None:
    """Register `PluginConfigs` with Hydra, once a process.

    Raises:
        UserError: `SWARMTWIN_PLUGINS` names what is no folder.
    """
    plugin_folders()
    Plugins.instance().register(PluginConfigs)
