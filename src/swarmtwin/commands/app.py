"""Runs one command as a Hydra app: composes its configuration, types it, turns a user's mistake into one line."""

import errno
import importlib
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError, near_miss

FAILED, MISUSED, INTERRUPTED = 1, 2, 130


def run_command(name: str, module_name: str, arguments: list[str]) -> int:
    """Run command `name` with Hydra `arguments`; return its exit status."""
    os.environ["HYDRA_FULL_ERROR"] = "1"
    signal.signal(signal.SIGTERM, _interrupt)
    _start_logging()
    config_name = name
    arguments = _spell_out(name, arguments)
    sys.argv = [f"swarmtwin {name}", *arguments]
    try:
        if name == "experiment":
            if "--help" in arguments and not any(argument.startswith("name=") for argument in arguments):
                print(f"swarmtwin experiment name=NAME [--help], where NAME is one of: {', '.join(_experiments())}")
                return 0
            chosen = _chosen_experiment(arguments)
            config_name, module_name = f"experiment/{chosen}", f"experiments.{chosen}"
        module = importlib.import_module(f"swarmtwin.commands.{module_name}")
        failures: list[Exception] = []
        app = hydra.main(config_path=str(config_folder()), config_name=config_name, version_base="1.3")
        app(_task(module, failures))()
        if failures:
            raise failures[0]
    except UserError as error:
        return _report(name, str(error), FAILED)
    except (HydraException, OmegaConfBaseException) as error:
        return _report(name, explain(error, config_name, arguments), MISUSED)
    except OSError as error:
        return _report(name, _explain_system_fault(error), FAILED)
    except MemoryError:
        return _report(name, "out of memory: ask for less at a time", FAILED)
    except KeyboardInterrupt:
        return _report(name, "interrupted; what had not finished was left out", INTERRUPTED)
    return 0


MODEL_FOLDERS = {"rollout": "policy"}
"""Options that name a model's folder, where other commands have a group of configurations of that name."""


def _spell_out(name: str, arguments: list[str]) -> list[str]:
    """Turn policy=FOLDER into policy.folder=FOLDER: of policy=... Hydra thinks that it chooses from conf/policy/."""
    option = MODEL_FOLDERS.get(name)
    return [
        argument.replace("=", ".folder=", 1) if option and argument.startswith(f"{option}=") else argument
        for argument in arguments
    ]


SYSTEM_FAULTS = {
    errno.ENOSPC: "the disk is full: make room and run the same command again",
    errno.EDQUOT: "the disk quota is used up: make room and run the same command again",
    errno.EACCES: "no permission to read or write",
    errno.EROFS: "the output is on a read-only file system: choose another output",
}


def _explain_system_fault(error: OSError) -> str:
    what = SYSTEM_FAULTS.get(error.errno or 0, error.strerror or str(error))
    where = f" ({error.filename})" if error.filename else ""
    return f"{what}{where}; no output was changed"


def _task(module: Any, failures: list[Exception]) -> Callable[[DictConfig], Any]:
    """Return what Hydra calls. A single run's failure is kept, since Hydra would print more than the one line."""

    def task(config: DictConfig) -> Any:
        try:
            content = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            return module.run(module.Options.parse(content, "options"))
        except Exception as error:
            if HydraConfig.get().mode != RunMode.RUN:
                raise
            failures.append(error)

    return task


def explain(error: Exception, config_name: str, arguments: Sequence[str]) -> str:
    """Say in one line what a Hydra or OmegaConf error means and what to do, naming the option probably meant.

    `arguments` tell which choices of groups the options belong to.
    """
    text = str(error)
    if isinstance(error, MissingMandatoryValue):
        return f"option {error.full_key!r} is missing: add {error.full_key}=..."
    if isinstance(error, MissingConfigException):
        if missing := re.search(r"Could not find '([^']+)/([^'/]+)'", text):
            group, choice = missing.groups()
            known = [path.stem for path in (config_folder() / group).glob("*.yaml")]
            return f"no such {group}: {choice!r}: {near_miss(choice, known)}"
        return text.splitlines()[0]
    if unknown := re.search(r"Could not override '([^']+)'", text):
        option = unknown.group(1)
        return f"unknown option {option!r}: {near_miss(*_unknown_and_known(config_name, option, arguments))}"
    return " ".join(text.split())


def _unknown_and_known(config_name: str, option: str, arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Return the first part of a dotted `option` that does not exist, and the options there are in its place."""
    shipped = {f"{path.parent.name}={path.stem}" for path in config_folder().glob("*/*.yaml")}
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = hydra.compose(config_name)
        choices = [choice for choice in arguments if choice in shipped and choice.partition("=")[0] in config]
        config = hydra.compose(config_name, choices)
    parent = option.rpartition(".")[0]
    if parent and OmegaConf.select(config, parent) is None:
        return _unknown_and_known(config_name, parent, arguments)
    node = OmegaConf.select(config, parent) if parent else config
    prefix = f"{parent}." if parent else ""
    return option, [f"{prefix}{key!s}" for key in node] if isinstance(node, DictConfig) else []


def _experiments() -> list[str]:
    return sorted(path.stem for path in (config_folder() / "experiment").glob("*.yaml"))


def _chosen_experiment(arguments: list[str]) -> str:
    """Find the experiment in `name=...`: its options stand in conf/experiment/<name>.yaml."""
    known = _experiments()
    chosen = [argument.partition("=")[2] for argument in arguments if argument.startswith("name=")]
    if not chosen:
        raise UserError(f"say which: name=..., {near_miss('', known)}")
    if chosen[-1] not in known:
        raise UserError(f"no such experiment: {chosen[-1]!r}: {near_miss(chosen[-1], known)}")
    return chosen[-1]


def _report(name: str, message: str, status: int) -> int:
    print(f"swarmtwin {name}: {message}", file=sys.stderr)
    return status


def _start_logging() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    for noisy in ("alembic", "mlflow", "lightning", "matplotlib", "fontTools", "hydra"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def _interrupt(signal_number: int, frame: Any) -> NoReturn:
    raise KeyboardInterrupt
