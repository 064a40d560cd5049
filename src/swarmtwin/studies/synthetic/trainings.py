"""The trainings that are compared: each a model, and real or synthetic transitions for it to learn from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from swarmtwin.dynamics.model_folder import MODEL_FOLDER, load_dynamics, read_description
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.training import TrainingJob
from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import folder_digest
from swarmtwin.generators.generator import Generator, GeneratorConfig
from swarmtwin.generators.generator_folder import DESCRIPTION, Lineage, load_generator
from swarmtwin.generators.sampling import draw_believable
from swarmtwin.generators.training import fit
from swarmtwin.robot import Robot
from swarmtwin.studies.training_sets import TrainedModel, count_real, described_part
from swarmtwin.transitions import Preparation, Transitions, first_runs, mix

Amount = Literal["all", "part", "few"]
Prepared = tuple[Transitions, Preparation]


@dataclass(frozen=True)
class Case:
    """One training.

    Attributes:
        title: what a person reads.
        model: the dynamics model that learns.
        source: what it learns from: real transitions, those of one of the generators, or a mixture with the better one.
        real: how many real transitions there are, for the model or for its generator.
        real_share: of a mixture.
        at_epochs: trained for as many passes as the model on all real transitions, instead of as many steps.
        as_many: learns from only as many synthetic transitions as there are real ones in all.
        walls: given the walls beside the pose, as the ensemble and the generator are.
    """

    title: str
    model: str
    source: Literal["real", "published", "generator", "mixture"]
    real: Amount = "all"
    real_share: float = 1.0
    at_epochs: bool = False
    as_many: bool = False
    walls: bool = False


CASES = {
    "real": Case("CR-Net-R", "crnet", "real"),
    "real_walls": Case("CR-Net-R, given the walls", "crnet", "real", walls=True),
    "ensemble": Case("ensemble-R", "ensemble", "real"),
    "published": Case("CR-Net-S, published GAN", "crnet", "published"),
    "generator": Case("CR-Net-S", "crnet", "generator"),
    "generator_as_many": Case("CR-Net-S, as many rows as real", "crnet", "generator", as_many=True),
    "mixture_25": Case("CR-Net, 25 % real", "crnet", "mixture", real_share=0.25),
    "mixture_50": Case("CR-Net, 50 % real", "crnet", "mixture", real_share=0.5),
    "mixture_75": Case("CR-Net, 75 % real", "crnet", "mixture", real_share=0.75),
    "real_part": Case("CR-Net-R", "crnet", "real", "part"),
    "real_walls_part": Case("CR-Net-R, given the walls", "crnet", "real", "part", walls=True),
    "ensemble_part": Case("ensemble-R", "ensemble", "real", "part"),
    "real_part_epochs": Case("CR-Net-R, equal epochs", "crnet", "real", "part", at_epochs=True),
    "published_part": Case("CR-Net-S, published GAN", "crnet", "published", "part"),
    "generator_part": Case("CR-Net-S", "crnet", "generator", "part"),
    "real_few": Case("CR-Net-R", "crnet", "real", "few"),
    "ensemble_few": Case("ensemble-R", "ensemble", "real", "few"),
    "real_few_epochs": Case("CR-Net-R, equal epochs", "crnet", "real", "few", at_epochs=True),
    "generator_few": Case("CR-Net-S", "crnet", "generator", "few"),
    "mlp_real": Case("plain MLP-R", "mlp", "real"),
    "mlp_walls": Case("plain MLP-R, given the walls", "mlp", "real", walls=True),
    "mlp_generator": Case("plain MLP-S", "mlp", "generator"),
    "mlp_real_part": Case("plain MLP-R", "mlp", "real", "part"),
    "mlp_generator_part": Case("plain MLP-S", "mlp", "generator", "part"),
    "mlp_real_few": Case("plain MLP-R", "mlp", "real", "few"),
    "mlp_generator_few": Case("plain MLP-S", "mlp", "generator", "few"),
}


def chosen_cases(names: Sequence[str] | Literal["all"], robot: Robot) -> dict[str, Case]:
    """Return the cases asked for, that on all real transitions always among them: the others are compared with it.

    Those that differ by the walls alone are left out for robots whose motion does not depend on the pose.

    Raises:
        UserError: there is no such case.
    """
    for name in names if names != "all" else ():
        if name not in CASES:
            raise UserError(f"cases: no such case: {name!r}: {near_miss(name, CASES)}")
    return {
        name: case
        for name, case in CASES.items()
        if (name == "real" or names == "all" or name in names) and not (case.walls and "pose" not in robot.situation)
    }


@dataclass
class TrainingSets:
    """Makes the transitions that each case learns from; each generator is trained once.

    Attributes:
        real: all real transitions, and how they came about.
        less: how many real transitions a case is given that is not given all.
        drawn: how many synthetic ones a case is given, if it does not want as many as there are real ones.
        configs: of the published generator and of the better one.
        folder: where trained generators are, one folder each as `generate` leaves it; those missing are trained.
        seed: of generators trained here, and of drawing.
    """

    real: Prepared
    less: Mapping[Amount, int]
    drawn: int
    configs: Mapping[str, GeneratorConfig]
    folder: Path
    seed: int
    _trained: dict[tuple[str, Amount], tuple[Generator, Lineage, str]] = field(default_factory=dict)

    def of(self, case: Case) -> Prepared:
        """Return what a case learns from.

        Raises:
            UserError: there is too little data for it.
        """
        if case.source == "real":
            return self._real_part(case.real)
        if case.source == "mixture":
            return mix(self.real, self._synthetic("generator", "all", self._real_count), case.real_share)
        count = self._real_count if case.as_many else self.drawn
        return self._synthetic(case.source, case.real, count)

    @property
    def _real_count(self) -> int:
        """How many real transitions there are, training and validation together."""
        return count_real(self.real[1])

    def _real_part(self, amount: Amount) -> Prepared:
        if amount == "all":
            return self.real
        return described_part(self.real[1], first_runs(self.real[0], self.less[amount]))

    def _synthetic(self, source: str, amount: Amount, count: int) -> Prepared:
        generator, lineage, digest = self._generator(source, amount)
        drawn = draw_believable(generator, count, self.seed)
        return lineage.synthetic(generator.columns, drawn, generator.config.name, digest, self.seed)

    def _generator(self, source: str, amount: Amount) -> tuple[Generator, Lineage, str]:
        """Return a generator trained on so much real data, its lineage, and its digest where it has a folder."""
        if (source, amount) not in self._trained:
            made = self.folder / self.configs[source].name / "generator"
            if amount == "all" and (made / DESCRIPTION).exists():
                generator, description = load_generator(made)
                self._trained[source, amount] = generator, description.lineage, folder_digest(made)
            else:
                part, preparation = self._real_part(amount)
                generator, _ = fit(part, self.configs[source], self.seed)
                self._trained[source, amount] = generator, Lineage.of(preparation, part, self.seed), "not kept"
        return self._trained[source, amount]


@dataclass(frozen=True)
class Training:
    """A case to train.

    Attributes:
        name: the case's.
        case: what is trained on what.
        preparation: how the transitions came about that it learns from.
        jobs: one a seed.
    """

    name: str
    case: Case
    preparation: Preparation
    jobs: tuple[TrainingJob, ...]

    @property
    def inputs(self) -> str:
        """What the model is given: parts of the situation, and the walls."""
        config, robot = self.jobs[0].config, self.jobs[0].transitions.robot
        inputs = config.inputs(robot)
        return ", ".join((*inputs, "walls") if config.wall_reaches and "pose" in inputs else inputs)

    @property
    def steps(self) -> int:
        """How many optimiser steps each takes."""
        job = self.jobs[0]
        rows = len(job.transitions.part("train"))
        return (job.recipe.epochs or 0) * (rows // min(job.recipe.batch_size, rows))

    @property
    def real_rows(self) -> int:
        """How many real transitions its model, or the generator that it learns from, was trained on and chosen by."""
        counts, generator = self.preparation.transitions, self.preparation.generator
        if generator and self.case.source != "mixture":
            return generator.real_transitions
        return round(self.case.real_share * (counts["train"] + counts["validation"]))


def trained_before(folders: Sequence[Path], job: TrainingJob, preparation: Preparation) -> TrainedModel | None:
    """Return the model in one of some folders that came of the very same training; None where there is none.

    Args:
        folders: as `train` leaves them; those that do not exist are passed over.
        job: the training.
        preparation: how the transitions came about that it learns from.

    Raises:
        UserError: a model's folder is damaged.
    """
    wanted = job.config.model_dump(mode="json"), job.transitions.robot
    for folder in folders:
        if not (folder / MODEL_FOLDER.description_file).exists():
            continue
        description = read_description(folder)
        provenance = Provenance.read(folder)
        if (description.model, description.robot) != wanted or provenance.seed != job.seed:
            continue
        if provenance == Provenance.of(preparation, job.recipe.model_dump(mode="json"), job.seed, provenance.seeds):
            return TrainedModel(job.seed, load_dynamics(folder), provenance)
    return None
