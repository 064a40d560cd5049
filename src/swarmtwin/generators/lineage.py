"""Where a generator comes from, and therefore what is drawn from it."""

from typing import Literal

from swarmtwin.generators.sampling import Drawn, synthetic_transitions
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.transitions import Fractions, GeneratorOrigin, Preparation, Transitions
from swarmtwin.transitions.preparation import CountsByReason, counts_by_split, runs_by_split


class Lineage(StrictModel):
    """What a generator learned from.

    Attributes:
        recording: name of the recording's folder.
        digest: identifies the content of the recording's runs.
        source: where the recording comes from, in its own words.
        vehicles: the vehicles learned from.
        fractions: how the recording was split.
        transitions: real ones it was trained on, and real ones its training was followed by.
        learned: digests of the tracks it may have seen: train and validation.
        seed: of the training.
    """

    recording: str
    digest: str
    source: str
    vehicles: tuple[str, ...]
    fractions: Fractions
    transitions: dict[Literal["train", "validation"], int]
    learned: tuple[str, ...]
    seed: int

    @classmethod
    def of(cls, preparation: Preparation, learned_from: Transitions, seed: int) -> "Lineage":
        """Describe a generator trained on those of the prepared transitions that it `learned_from`."""
        return cls(
            recording=preparation.recording,
            digest=preparation.digest,
            source=preparation.source,
            vehicles=preparation.vehicles,
            fractions=preparation.fractions,
            transitions={"train": len(learned_from.part("train")), "validation": len(learned_from.part("validation"))},
            learned=preparation.learned,
            seed=seed,
        )

    @property
    def real_transitions(self) -> int:
        """How many real transitions were used."""
        return sum(self.transitions.values())

    def synthetic(
        self, robot: Robot, drawn: Drawn, name: str, digest: str, seed: int
    ) -> tuple[Transitions, Preparation]:
        """Turn rows drawn from generator `name` with `seed` into transitions with lineage, split as the real ones."""
        validation = round(len(drawn.rows) * self.transitions["validation"] / self.real_transitions)
        transitions = synthetic_transitions(robot, drawn.rows, max(2, validation))
        preparation = Preparation(
            robot=robot.name,
            recording=self.recording,
            digest=self.digest,
            source=self.source,
            vehicles=self.vehicles,
            fractions=self.fractions,
            seed=seed,
            counts=CountsByReason(
                rows=0,
                dropped_rows={},
                considered=len(drawn.rows) + drawn.redrawn,
                kept=len(drawn.rows),
                dropped={"unbelievable": drawn.redrawn} if drawn.redrawn else {},
            ),
            runs=runs_by_split(transitions),
            transitions=counts_by_split(transitions),
            learned=self.learned,
            origin="synthetic",
            generator=GeneratorOrigin(name=name, digest=digest, seed=seed, real_transitions=self.real_transitions),
        )
        return transitions, preparation
