"""Where a policy comes from: the simulation it was learned in, how, and how good it was there."""

from typing import Any

from swarmtwin.robot import StrictModel


class SimulationOrigin(StrictModel):
    """The dynamics model that a policy was learned in.

    Attributes:
        source: how it was named: a folder, or models:/NAME/VERSION.
        model: the kind of model.
        digest: identifies its content.
        recording: name of the recording it was trained on.
        origin: whether its transitions were real, synthetic or mixed.
    """

    source: str
    model: str
    digest: str
    recording: str
    origin: str


class Evaluated(StrictModel):
    """What roll-outs in the evaluation scenes gave: shares of the roll-outs, and the mean reward a step."""

    step: int
    success: float
    reward: float
    collision: float
    left_arena: float


class SeedOutcome(StrictModel):
    """What came of one seed: its best evaluation, and why it cannot be used, if it cannot."""

    seed: int
    best: Evaluated | None
    failed: str | None


class PolicyProvenance(StrictModel):
    """What `policy.yaml` says of a policy's origin.

    Attributes:
        simulation: the model it was learned in.
        algorithm: how it was learned, all values.
        schedule: how long, and how it was evaluated.
        seed: the seed chosen, best in the evaluation scenes.
        seeds: what came of each.
    """

    simulation: SimulationOrigin
    algorithm: dict[str, Any]
    schedule: dict[str, Any]
    seed: int
    seeds: tuple[SeedOutcome, ...]

    @property
    def evaluation(self) -> Evaluated:
        """How good the policy was in the evaluation scenes."""
        best = next(outcome for outcome in self.seeds if outcome.seed == self.seed).best
        assert best is not None
        return best

    def tags(self, task: str) -> dict[str, str]:
        """Return what people should read beside a registered version: the task, and how good it was in simulation."""
        return {
            "task": task,
            "algorithm": str(self.algorithm["name"]),
            "simulation": f"{self.simulation.model} ({self.simulation.origin})",
            "success": f"{self.evaluation.success:.3f}",
            "reward": f"{self.evaluation.reward:.3f}",
        }
