"""Where a dynamics model comes from, and which runs it has therefore never seen."""

from pathlib import Path
from typing import Any, Self

from pydantic import model_validator

from swarmtwin.dynamics.model_folder import MODEL_FOLDER
from swarmtwin.errors import UserError
from swarmtwin.recordings.recognition import recognised
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import StrictModel
from swarmtwin.transitions import GeneratorOrigin, Origin, Preparation, RecordingOrigin


class SeedOutcome(StrictModel):
    """What came of one seed: its errors on the validation runs at its best epoch, and why it is dead, if it is.

    A seed that diverged at once has no best epoch (0) and no errors.
    """

    seed: int
    best_epoch: int
    position_mm: float | None
    orientation_deg: float | None
    dead: str | None

    @property
    def errors(self) -> dict[str, float]:
        """The errors by name and unit, none for a seed that diverged at once."""
        named = {"position_mm": self.position_mm, "orientation_deg": self.orientation_deg}
        return {name: error for name, error in named.items() if error is not None}


class Provenance(RecordingOrigin):
    """What `model.yaml` says of a model's origin.

    Attributes:
        runs: names of the runs in each split.
        learned: marks of the tracks it was trained on or chosen by.
        recipe: how it was trained, all values known.
        seed: the seed chosen, best on the validation runs.
        seeds: what came of each.
        origin: whether it was trained on real transitions, on synthetic ones, or on some of each.
        generator: where the synthetic ones come from.
    """

    runs: dict[str, tuple[str, ...]]
    learned: tuple[str, ...]
    recipe: dict[str, Any]
    seed: int
    seeds: tuple[SeedOutcome, ...]
    origin: Origin = "real"
    generator: GeneratorOrigin | None = None

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read where the model in `folder` comes from.

        Raises:
            UserError: there is no model, or its description is damaged.
        """
        return cls.parse(MODEL_FOLDER.read(folder).provenance, f"{folder / MODEL_FOLDER.description_file}: provenance")

    @classmethod
    def of(cls, preparation: Preparation, recipe: dict[str, Any], seed: int, seeds: tuple[SeedOutcome, ...]) -> Self:
        """Describe a model trained on prepared transitions."""
        return cls.shared_with(
            preparation,
            runs=preparation.runs,
            learned=preparation.learned,
            recipe=recipe,
            seed=seed,
            seeds=seeds,
            origin=preparation.origin,
            generator=preparation.generator,
        )

    @model_validator(mode="after")
    def _chosen_seed_is_known(self) -> Self:
        if self.seed not in [outcome.seed for outcome in self.seeds]:
            raise ValueError(f"seed {self.seed} is not among seeds")
        return self

    @property
    def chosen(self) -> SeedOutcome:
        """The outcome of the seed that became the model."""
        return next(outcome for outcome in self.seeds if outcome.seed == self.seed)

    def tags(self, model: str) -> dict[str, str]:
        """Return what people should read beside a registered version: model, origin of its data, validation errors."""
        errors = {name: f"{error:.4g}" for name, error in self.chosen.errors.items()}
        generator = (
            {"generator": self.generator.name, "generator.digest": self.generator.digest} if self.generator else {}
        )
        return {"model": model, **errors, "origin": self.origin, **generator}

    def unseen_part(self, recording: Recording) -> Recording:
        """Return what the model has not seen of a recording: not the tracks it was trained on or chosen by.

        Tracks are known by what was measured, so that a copy, a part or another format of a recording is recognised,
        however its runs are cut into blocks.

        Raises:
            UserError: nothing is left.
        """
        part = recording.without(recognised(recording.tracks, set(self.learned)))
        if len(part.tracks) == len(recording.tracks):
            return recording
        if not part.tracks:
            raise UserError(
                f"the model was trained on every run of recording {self.recording!r}: "
                "evaluate on another recording, or train with a test fraction above 0"
            )
        return part
