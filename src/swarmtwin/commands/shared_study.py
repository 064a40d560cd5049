"""An Optuna study that processes share, and what it was made for."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from sqlalchemy.exc import SQLAlchemyError

from swarmtwin.errors import UserError

MADE_FOR = "made_for"
DONE = (TrialState.COMPLETE, TrialState.FAIL)


def identity(parts: Mapping[str, Any]) -> dict[str, str]:
    """Return a digest of each part of what a study is made for."""
    texts = {name: json.dumps(part, sort_keys=True) for name, part in parts.items()}
    return {name: hashlib.sha256(text.encode()).hexdigest()[:8] for name, text in texts.items()}


@dataclass(frozen=True)
class SharedStudy:
    """A study that processes share.

    Attributes:
        name: its name.
        storage: the journal file or database that holds it.
        made_for: digests by name of all that its trials have in common; trials of anything else are no part of it.
    """

    name: str
    storage: str
    made_for: Mapping[str, str]

    @classmethod
    def named(cls, name: str | None, prefix: str, storage: str | None, made_for: Mapping[str, str]) -> "SharedStudy":
        """Fill in the name, `prefix` and a digest, and the storage, where they are left open."""
        name = name or f"{prefix}-{identity({'study': dict(made_for)})['study']}"
        return cls(name, storage or f"outputs/tune/{name}.journal", made_for)

    @property
    def place(self) -> str:
        """The storage as a person may see it, without a database's password."""
        return re.sub(r"(://[^:/@]*):[^@/]*@", r"\1:***@", self.storage)

    def open(self, sampler: optuna.samplers.BaseSampler | None = None) -> optuna.Study:
        """Open the study, made on the way if there is none.

        Args:
            sampler: draws the values of its trials.

        Raises:
            UserError: the storage cannot be opened, or the study was made for something else.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        try:
            study = optuna.create_study(
                storage=self._storage(),
                study_name=self.name,
                sampler=sampler,
                direction="minimize",
                load_if_exists=True,
            )
            known, begun = study.user_attrs.get(MADE_FOR), bool(study.get_trials(deepcopy=False))
            if known is None and not begun:
                study.set_user_attr(MADE_FOR, dict(self.made_for))
                return study
        except (OSError, ImportError, ValueError, LookupError, SQLAlchemyError, optuna.exceptions.OptunaError) as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise UserError(
                f"storage {self.place} cannot be opened ({reason}): name a journal file, or a database by its URL, "
                "sqlite:///study.db"
            ) from None
        if other := [part for part, digest in self.made_for.items() if (known or {}).get(part) != digest]:
            raise UserError(
                f"study {self.name!r} in {self.place} was made for another {', '.join(other)}: choose another "
                "study=..., or leave it out"
            )
        return study

    def _storage(self) -> BaseStorage:
        if "://" in self.storage:
            return RDBStorage(self.storage)
        file = Path(self.storage).absolute()  # its lock is a link to it, and would dangle if this were relative
        if file.is_dir():
            raise IsADirectoryError("it is a folder")
        file.parent.mkdir(parents=True, exist_ok=True)
        return JournalStorage(JournalFileBackend(str(file)))


def complete_trials(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """Return the trials that gave a loss."""
    return study.get_trials(states=[TrialState.COMPLETE])


def trials_done(study: optuna.Study) -> int:
    """Count the trials that came to an end, well or badly; not those that run, or that a kill left behind."""
    return len(study.get_trials(deepcopy=False, states=DONE))
