"""An Optuna study that processes share, and what it was made for."""

import fcntl
import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedRandom
from pathlib import Path
from typing import Annotated, Any, Self

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import TrialState
from pydantic import Field, model_validator
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from swarmtwin.errors import UserError
from swarmtwin.robot import StrictModel

MADE_FOR = "made_for"
DONE = (TrialState.COMPLETE, TrialState.FAIL, TrialState.PRUNED)


def identity(parts: Mapping[str, Any]) -> dict[str, str]:
    """Return a digest of each part of what a study is made for."""
    texts = {name: json.dumps(part, sort_keys=True) for name, part in parts.items()}
    return {name: hashlib.sha256(text.encode()).hexdigest()[:8] for name, text in texts.items()}


@dataclass(frozen=True)
class SharedStudy:
    """A study that processes share.

    Attributes:
        name: its name.
        storage: what holds it: a database's URL, an SQLite file that ends in `.db`, or a journal file of Optuna's.
        made_for: digests by name of all that its trials have in common; trials of anything else are no part of it.
        lock_timeout_s: how long a process waits for others that write to the same SQLite file.
    """

    name: str
    storage: str
    made_for: Mapping[str, str]
    lock_timeout_s: float = 60.0

    @classmethod
    def named(cls, name: str | None, prefix: str, storage: str | None, made_for: Mapping[str, str]) -> "SharedStudy":
        """Fill in the name, `prefix` and a digest, and the storage, where they are left open."""
        name = name or f"{prefix}-{identity({'study': dict(made_for)})['study']}"
        file = re.sub(r"[?{}]", "_", name)  # they mean something in a URL
        return cls(name, storage or f"sqlite:///outputs/tune/{file}.db", made_for)

    @property
    def place(self) -> str:
        """The storage as a person may see it, without a database's password."""
        return re.sub(r"(://[^:/@]*):[^@/]*@", r"\1:***@", self.storage)

    def open(self) -> optuna.Study:
        """Open the study, made on the way if there is none.

        Raises:
            UserError: the storage cannot be opened, or the study was made for something else.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        try:
            study = optuna.create_study(
                storage=self._storage(),
                study_name=self.name,
                direction="minimize",
                load_if_exists=True,
            )
            begun = bool(study.get_trials(deepcopy=False))  # first: whoever adds a trial has named its purpose before
            known = study.user_attrs.get(MADE_FOR)
            if known is None and not begun:
                study.set_user_attr(MADE_FOR, dict(self.made_for))
                known = study.user_attrs.get(MADE_FOR)
        except (OSError, ImportError, ValueError, LookupError, SQLAlchemyError, optuna.exceptions.OptunaError) as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise UserError(
                f"storage {self.place} cannot be opened ({reason}): name a database by its URL, sqlite:///study.db, "
                "or a journal file"
            ) from None
        if other := [part for part, digest in self.made_for.items() if (known or {}).get(part) != digest]:
            raise UserError(
                f"study {self.name!r} in {self.place} was made for another {', '.join(other)}: choose another "
                "study=..., or leave it out"
            )
        return study

    def _storage(self) -> BaseStorage:
        if "://" not in self.storage and not self.storage.endswith(".db"):
            file = _place_of(self.storage)
            return JournalStorage(JournalFileBackend(str(file), _JournalLock(file)))
        url = self.storage if "://" in self.storage else f"sqlite:///{self.storage}"
        parts = make_url(url)
        if parts.get_backend_name() != "sqlite" or not parts.database:
            return RDBStorage(url)
        with _one_at_a_time(_place_of(parts.database)):
            return RDBStorage(url, engine_kwargs={"connect_args": {"timeout": self.lock_timeout_s}})


def _place_of(name: str) -> Path:
    """Return the file of a storage, in a folder that is made if need be."""
    file = Path(name).absolute()
    if file.is_dir():
        raise IsADirectoryError("it is a folder")
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


@contextmanager
def _one_at_a_time(database: Path) -> Iterator[None]:
    """Let one process at a time open a database file: Optuna makes its tables unless they are there, and two fail."""
    with database.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield


class _JournalLock(JournalFileOpenLock):
    """Lets one process at a time write a journal, which the system lets go of when the process dies.

    Optuna's own lock is a file that a killed process leaves behind, and that others wait half a minute for. A line that
    such a process left unfinished, or a full disk, is removed: no reader would get beyond it.
    """

    def __init__(self, journal: Path) -> None:
        self._journal = journal
        self._held: BufferedRandom | None = None

    def acquire(self) -> bool:
        """Wait until the journal is this process's to write."""
        self._held = self._journal.open("a+b")
        fcntl.flock(self._held, fcntl.LOCK_EX)
        if end := self._held.seek(0, os.SEEK_END):
            self._held.seek(end - 1)
            if self._held.read() != b"\n":
                self._held.seek(0)
                self._held.truncate(self._held.read().rfind(b"\n") + 1)
        return True

    def release(self) -> None:
        """Leave the journal to others."""
        assert self._held is not None
        self._held.close()


def complete_trials(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """Return the trials that gave a loss."""
    return study.get_trials(states=[TrialState.COMPLETE])


def trials_done(study: optuna.Study) -> int:
    """Count the trials that came to an end, well or badly; not those that run, or that a kill left behind."""
    return len(study.get_trials(deepcopy=False, states=DONE))


class Range(StrictModel):
    """Where to search one option: between two numbers, or among choices."""

    low: float | None = None
    high: float | None = None
    log: bool = False
    choices: Annotated[tuple[bool | int | float | str, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.low is None) != (self.high is None) or (self.choices is None) == (self.low is None):
            raise ValueError("give low and high, or choices")
        if self.low is not None and self.high is not None:
            if not self.low < self.high:
                raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
            if self.log and self.low <= 0:
                raise ValueError(f"log needs a low above 0, got {self.low:g}")
        return self

    def __str__(self) -> str:
        if self.choices is not None:
            return f"among {', '.join(map(str, self.choices))}"
        return f"{self.low:g} to {self.high:g}{', log' if self.log else ''}"

    def suggest(self, trial: optuna.Trial, name: str, whole: bool) -> Any:
        """Let Optuna choose a value; a `whole` number where the option takes no other."""
        if self.choices is not None:
            return trial.suggest_categorical(name, self.choices)
        assert self.low is not None
        assert self.high is not None
        if whole:
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    def takes_whole_numbers(self, name: str, check: Callable[[Any], Any]) -> bool:
        """Return whether option `name` takes whole numbers alone; `check` raises UserError for values that it refuses.

        Raises:
            UserError: the option refuses a choice, or what lies within the range.
        """
        if self.choices is not None:
            for choice in self.choices:
                check(choice)
            return False
        assert self.low is not None
        assert self.high is not None
        if _accepts(check, _between_whole_numbers(self.low, self.high)):
            # An option may refuse the bound itself, as a rate must be above 0: it is never drawn. What lies so far
            # inside counts.
            for share in (1e-9, 1 - 1e-9):
                check(self.low + share * (self.high - self.low))
            return False
        if not (self.low.is_integer() and self.high.is_integer()):
            check(math.ceil(self.low))
            raise UserError(f"{name} takes whole numbers: give such as low and high")
        check(int(self.low))
        check(int(self.high))
        return True


def _accepts(check: Callable[[Any], Any], value: Any) -> bool:
    try:
        check(value)
    except UserError:
        return False
    return True


def _between_whole_numbers(low: float, high: float) -> float:
    """Return a number from `low` to `high` that is not whole."""
    return low + (min(high, math.floor(low) + 1) - low) / 2
