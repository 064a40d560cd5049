"""Trains what a grid asks for and measures it, side by side in processes; each leaves what it made in the store."""

import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from swarmtwin.dynamics.training import TrainingJob
from swarmtwin.errors import UserError
from swarmtwin.generators.generator_folder import Lineage
from swarmtwin.generators.sampling import draw_believable
from swarmtwin.generators.training import fit
from swarmtwin.learning.device import Device
from swarmtwin.learning.parallel import Report
from swarmtwin.simulation.evaluation import Measured, measure
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.studies.training_grid.grid_data import GridData, RealPart, steps_an_epoch, with_noise
from swarmtwin.studies.training_grid.measured_errors import MeasuredErrors
from swarmtwin.studies.training_grid.training_store import TrainingOutcome, TrainingStore, key_of
from swarmtwin.studies.training_grid.trainings import Training
from swarmtwin.studies.training_sets import trained_model
from swarmtwin.transitions import mix
from swarmtwin.transitions.mixing import Prepared


@dataclass(frozen=True)
class Job:
    """What is trained and kept, one seed of it.

    Attributes:
        data: what trainings are made of.
        store: where its outcome is kept.
        training: which, or which wants it.
        seed: of initial weights, of order, dropout and drawing, and of which real runs it is given.
        device: where to train.
        made_of: all that decides what comes of it.
    """

    data: GridData
    store: TrainingStore
    training: Training
    seed: int
    device: Device
    made_of: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The digest of what it is made of."""
        return key_of(self.made_of)


@dataclass(frozen=True)
class GeneratorJob(Job):
    """The generator of a training, to be trained and kept."""

    def run(self, report: Report | None) -> None:
        """Train; why that failed is kept as well, so that the trainings that want it say so."""
        began = time.monotonic()
        real, preparation = self.data.real_part(self.training, self.seed)
        rows = len(real.part("train"))
        config = self.data.generator_config(self.training, rows)
        trained, dead = None, None
        try:
            generator, _ = fit(real, config, self.seed, device=self.device)
            trained = generator, Lineage.of(preparation, real, self.seed)
        except UserError as error:
            dead = str(error)
        outcome = TrainingOutcome(
            made_of=dict(self.made_of),
            seconds=time.monotonic() - began,
            steps=config.training_steps,
            learned_from=rows,
            dead=dead,
        )
        self.store.keep_generator(self.key, trained, outcome)
        if report:
            report(outcome.seconds)


@dataclass(frozen=True)
class MeasuredTrainingJob(Job):
    """One seed of a training, to be trained, kept, and measured on recordings; its generator lies in the same store.

    Attributes:
        measured: the recordings, by what they are for.
    """

    measured: Mapping[str, Measured]

    @property
    def is_done(self) -> bool:
        """Whether it is trained, and measured on every recording unless it is dead."""
        if not self.store.has(self.key):
            return False
        return self.store.outcome(self.key).dead is not None or not self._unmeasured()

    def run(self, report: Report | None) -> None:
        """Train and measure what is not in the store."""
        if not self.store.has(self.key):
            self._train()
        if self.store.outcome(self.key).dead is None:
            self._measure()
        if report:
            report(self.store.outcome(self.key).seconds)

    def errors(self) -> dict[str, MeasuredErrors] | None:
        """Return how it measured, by recording; None where it is dead.

        Raises:
            UserError: a file in the store is damaged.
        """
        if self.store.outcome(self.key).dead:
            return None
        found = {name: self.store.measured(self.key, key_of_recording(one)) for name, one in self.measured.items()}
        return {name: errors for name, errors in found.items() if errors}

    def _train(self) -> None:
        began = time.monotonic()
        try:
            transitions, preparation = self._training_set()
        except UserError as error:
            self.store.keep_model(
                self.key,
                None,
                TrainingOutcome(made_of=dict(self.made_of), seconds=time.monotonic() - began, dead=str(error)),
            )
            return
        rows = len(transitions.part("train"))
        recipe = self.data.recipe_for(self.training, rows)
        config = self.data.model_config(self.training)
        job = TrainingJob(transitions, config, recipe, self.seed, device=self.device)
        model = trained_model(job, preparation, job.run(None))
        outcome = TrainingOutcome(
            made_of=dict(self.made_of),
            seconds=time.monotonic() - began,
            epochs=job.epochs,
            steps=job.epochs * steps_an_epoch(recipe, rows),
            learned_from=rows,
            dead=model.dead,
        )
        self.store.keep_model(self.key, model, outcome)

    def _training_set(self) -> Prepared:
        """Return what is learned from.

        Raises:
            UserError: there is too little, or the generator cannot be used.
        """
        if self.training.generator is None:
            real, preparation = self.data.real_part(self.training, self.seed)
            return with_noise(real, self.training.noise, self.seed), preparation
        digest = str(self.made_of["generator"])
        generator, lineage = self.store.generator(digest)
        drawn = draw_believable(generator, self.data.drawn_count(self.training), self.seed)
        synthetic = lineage.synthetic(generator.columns, drawn, generator.config.name, digest, self.seed)
        if self.training.real_share:
            return mix(self.data.real, synthetic, self.training.real_share)
        return with_noise(synthetic[0], self.training.noise, self.seed), synthetic[1]

    def _unmeasured(self) -> list[Measured]:
        known = (self.store.measured(self.key, key_of_recording(one)) for one in self.measured.values())
        return [one for one, errors in zip(self.measured.values(), known, strict=True) if errors is None]

    def _measure(self) -> None:
        if not (missing := self._unmeasured()):
            return
        model = self.store.model(self.key, self.seed)
        assert model.dynamics is not None
        for measured in missing:
            errors = MeasuredErrors.of(measure(Simulation(model.dynamics), model.provenance, measured))
            self.store.keep_measured(self.key, key_of_recording(measured), errors)


def key_of_recording(measured: Measured) -> str:
    """Return what tells a recording, or the vehicles of it that are looked at, from others."""
    return key_of({"digest": measured.recording.digest, "vehicles": measured.recording.vehicles})[:16]


def planned_jobs(
    data: GridData,
    measured: Mapping[str, Measured],
    store: TrainingStore,
    trainings: Sequence[Training],
    seeds: Sequence[int],
    device: Device,
) -> tuple[list[MeasuredTrainingJob], list[GeneratorJob]]:
    """Return a job for each seed of each training, in that order, and one for each generator that they want, once.

    Raises:
        UserError: there are too few real transitions for one of them.
    """
    parts: dict[tuple[float, int | None], RealPart] = {}
    everything = data.identified_part(Training(model="any"), 0)
    jobs: list[MeasuredTrainingJob] = []
    generators: dict[str, GeneratorJob] = {}
    for training, seed in itertools.product(trainings, seeds):
        which = training.real, seed if training.real < 1 else None
        if which not in parts:
            parts[which] = data.identified_part(training, seed)
        real = parts[which]
        made_of = data.made_of(training, seed, real, everything)
        jobs.append(MeasuredTrainingJob(data, store, training, seed, device, made_of, measured))
        if training.generator:
            generator = GeneratorJob(data, store, training, seed, device, data.generator_made_of(training, seed, real))
            generators.setdefault(generator.key, generator)
    return jobs, list(generators.values())
