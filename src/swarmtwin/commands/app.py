"""Runs one command as a Hydra app: composes its configuration, types it, turns a user's mistake into one line."""

import contextlib
import errno
import gc
import importlib
import logging
import os
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn, cast

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from swarmtwin import __version__
from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.commands.experiment import chosen_experiments, experiments, study_module
from swarmtwin.commands.option_help import show_help
from swarmtwin.commands.option_mistakes import check_overrides, explain
from swarmtwin.commands.outside_config import check_outside_configs
from swarmtwin.commands.sweep_mistakes import check_sweep
from swarmtwin.commands.sweep_table import keep_row, read_rows, sweep_table
from swarmtwin.configuration import config_folder, let_hydra_find_plugins
from swarmtwin.errors import RefusedError, UserError
from swarmtwin.extras import require_extra


class Status(IntEnum):
    """The exit statuses of every command."""

    DONE = 0
    DEFECT = 1
    MISTAKE = 2
    REFUSED = 3
    INTERRUPTED = 130


def run_command(name: str, arguments: list[str]) -> Status:
    """Run command `name` with Hydra `arguments`; what goes wrong becomes one line on stderr.

    Returns:
        `DONE`; `MISTAKE`, which the user can put right; `REFUSED`, an answer that is "no"; `INTERRUPTED`; or `DEFECT`,
        ours: the line names a log file with the traceback.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if {"-m", "--multirun"} & set(arguments):
        answer_interrupts(_interrupt)
    _start_logging()
    arguments = _spelled_out(name, arguments)
    sys.argv = [f"swarmtwin {name}", *arguments]
    try:
        let_hydra_find_plugins()
        check_overrides(arguments)
        check_outside_configs(arguments)
        chosen = chosen_experiments(arguments) if name == "experiment" else [""]
        if not chosen:
            print(f"swarmtwin experiment name=NAME [--help], where NAME is one of: {', '.join(experiments())}")
        elif {"--help", "-h"} & set(arguments):
            title = " ".join([name, *(f"name={study}" for study in chosen[:1] if study)])
            show_help(title, f"experiment/{chosen[0]}" if chosen[0] else name, arguments)
        else:
            _run_all(name, chosen, arguments)
    except RefusedError as error:
        return _report(name, str(error), Status.REFUSED)
    except UserError as error:
        return _report(name, str(error), Status.MISTAKE)
    except yaml.YAMLError as error:
        return _report(name, f"a configuration is not valid YAML: {' '.join(str(error).split())}", Status.MISTAKE)
    except MemoryError:
        return _report(name, "out of memory: ask for less at a time", Status.MISTAKE)
    except KeyboardInterrupt as interrupt:
        came_of_it = str(interrupt) or "what had not finished was left out"
        return _report(name, f"interrupted; {came_of_it}", Status.INTERRUPTED)
    except Exception as error:
        if isinstance(error, OSError) and (remedy := _system_remedy(error)):
            return _report(name, remedy, Status.MISTAKE)
        return _report(name, f"{_first_line(error)}: a defect of swarmtwin; {_keep_traceback(error)}", Status.DEFECT)
    return Status.DONE


def _run_all(name: str, chosen: Sequence[str], arguments: list[str]) -> None:
    """Run a command, or the chosen studies of `experiment` one after the other; a sweep ends with its table.

    As in every sweep, what fails does not keep the others from running.
    """
    failures: list[Exception] = []
    with _folder_for_rows(arguments) as folder:
        try:
            for number, study in enumerate(chosen):
                config_name, module_name = name, f"swarmtwin.commands.{COMMANDS[name].module}"
                if study:
                    config_name, module_name = f"experiment/{study}", study_module(study)
                    others = [argument for argument in arguments if not argument.startswith("name=")]
                    sys.argv[1:] = [*others, f"name={study}"]
                try:
                    if len(chosen) == 1:
                        check_sweep(name, config_name, sys.argv[1:])
                    _run_app(name, module_name, config_name, Path(folder) / f"{number:06}")
                except (HydraException, OmegaConfBaseException) as error:
                    failures.append(UserError(explain(error, config_name, arguments)))
                except Exception as error:
                    failures.append(error)
        finally:
            if rows := read_rows(Path(folder)):
                Console().print(sweep_table(rows, COMMANDS[name].ranking), highlight=False)
    if failures:
        raise failures[0]


@contextlib.contextmanager
def _folder_for_rows(arguments: Sequence[str]) -> Iterator[str]:
    """Give a folder for what the runs of a sweep come to, where all machines that they may run on can write."""
    place, made = None, list[Path]()
    if {"-m", "--multirun"} & set(arguments):
        place = Path("outputs/sweeps").absolute()
        made = [folder for folder in (place, place.parent) if not folder.exists()]
        place.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=place, prefix=".rows-", suffix=".partial") as folder:
            yield folder
    finally:
        for one in made:
            with contextlib.suppress(OSError):  # something lies in it by now
                one.rmdir()


def _run_app(name: str, module_name: str, config_name: str, rows: Path) -> None:
    """Compose a configuration and run the module's `run` with the `Options` it makes, once for each run of a sweep.

    The module, and with it what it computes with, is imported only when there is something to run, and what it is to
    read is there.
    """
    failures: list[Exception] = []
    task = _task(name, module_name, failures, rows)
    if any(re.match(r"-|[+~]*hydra\b", argument) for argument in sys.argv[1:]):
        hydra.main(config_path=str(config_folder()), config_name=config_name, version_base="1.3")(task)()
    else:
        _run_once(task, config_name)
    if failures:
        raise failures[0]


def _run_once(task: Callable[[DictConfig], Any], config_name: str) -> None:
    """Compose a configuration and run a task with it, where all that is given are options of the command.

    `hydra.main` composes each twice, the first time only to learn whether it is a sweep.
    """
    with hydra.initialize_config_dir(str(config_folder()), job_name="swarmtwin", version_base="1.3"):
        config = hydra.compose(config_name, [*sys.argv[1:], "hydra.mode=RUN"], return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        task(OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"]))


def _spelled_out(name: str, arguments: list[str]) -> list[str]:
    """Turn policy=FOLDER and task=NAME into policy.folder= and task.name=: Hydra would look for them in conf/policy/.

    So it is where a policy is asked for that was learned, and for which task it was: not where one is to be learned.
    Likewise broker=ADDRESS; and `new NAME` is `new output=NAME`.
    """
    if name == "new" and arguments and re.fullmatch(r"[\w./~][\w./~-]*", arguments[0]):
        return [f"output={arguments[0]}", *arguments[1:]]
    if name not in ("rollout", "promote", "deploy", "collect", "fleet"):
        return arguments
    spelled = {"policy": "policy.folder", "task": "task.name", "broker": "broker.address"}
    return [re.sub(r"^(policy|task|broker)=", lambda short: f"{spelled[short[1]]}=", one) for one in arguments]


def _system_remedy(error: OSError) -> str | None:
    """Say what to do about a fault of the machine; None where the error is not one of those."""
    remedies = {
        errno.ENOSPC: "the disk is full: make room and run the same command again",
        errno.EDQUOT: "the disk quota is used up: make room and run the same command again",
        errno.EACCES: "no permission to read or write: choose another folder, or have it allowed",
        errno.EPERM: "no permission to read or write: choose another folder, or have it allowed",
        errno.ENAMETOOLONG: "the name of a file is too long: choose a shorter one",
        errno.EROFS: "the output is on a read-only file system: choose another output",
    }
    if error.errno not in remedies:
        return None
    named = Path(error.filename) if error.filename else None
    if named and named.suffix == ".partial":  # what an output is called until it is whole
        named = named.parent
    where = f" ({named})" if named else ""
    return f"{remedies[error.errno]}{where}; no output was changed"


def _first_line(error: Exception) -> str:
    return " ".join([type(error).__name__, *str(error).strip().splitlines()[:1]])


def _keep_traceback(error: Exception) -> str:
    """Write a traceback to a log file, and say where it is; where no file can be written, show it."""
    text = f"{' '.join(sys.argv)}\nswarmtwin {__version__}\n\n{''.join(traceback.format_exception(error))}"
    for folder in (Path("outputs/errors"), Path(tempfile.gettempdir())):
        file = folder / f"swarmtwin-{time.strftime('%Y-%m-%d_%H-%M-%S')}-{os.getpid()}.log"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
            return f"please report it with {file}"
    print(text, file=sys.stderr)
    return "please report it with the traceback above"


def _task(name: str, module_name: str, failures: list[Exception], rows: Path) -> Callable[[DictConfig], Any]:
    """Return what Hydra calls.

    A single run's failure is kept in `failures`: Hydra would print more than one line. What the runs of a sweep come to
    is kept in `rows`: they may be in other processes.
    """

    def task(config: DictConfig) -> Any:
        run = HydraConfig.get()
        try:
            content = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
            from swarmtwin.commands.inputs import check_inputs  # not for --help, which it would make wait

            check_inputs(name, cast(dict[str, Any], content))
            module = _imported(name, module_name)
            if not gc.isenabled():
                gc.freeze()
                gc.enable()
            if run.mode == RunMode.RUN:
                answer_interrupts(_interrupt)  # until here nothing has begun
            headline = module.run(module.Options.parse(content, "options"))
        except Exception as error:
            if run.mode == RunMode.RUN:
                failures.append(error)
                return None
            reason = str(error) if isinstance(error, UserError) else _first_line(error)
            keep_row(rows, run.job.num, run.overrides.task, {"failed": reason})
            raise
        if run.mode == RunMode.MULTIRUN:
            keep_row(rows, run.job.num, run.overrides.task, headline)
        return headline

    return task


def _imported(name: str, module_name: str) -> ModuleType:
    """Import what runs a command.

    Raises:
        UserError: packages of the command's extra are not installed.
    """
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError:
        require_extra(COMMANDS[name].extra, name)
        raise


def _report(name: str, message: str, status: Status) -> Status:
    print(f"swarmtwin {name}: {message}", file=sys.stderr)
    return status


def _start_logging() -> None:
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    for noisy in ("alembic", "mlflow", "lightning", "matplotlib", "fontTools", "hydra"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def answer_interrupts(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    """Let a handler answer Ctrl-C and SIGTERM; what a process was started to ignore it goes on ignoring."""
    for interrupt in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(interrupt) is not signal.SIG_IGN:
            signal.signal(interrupt, handler)


def _interrupt(signal_number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
