"""One seed: learned, tested in its simulation, and tried on stand-ins, in a process of its own."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from swarmtwin.learning.parallel import Report
from swarmtwin.policies.learned_folder import provenance_of
from swarmtwin.policies.policy_folder import SimulationOrigin, save_policy
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.policies.training import PolicyJob, SeedResult, policy_of, tested
from swarmtwin.studies.policy_seeds.options import SIMULATION
from swarmtwin.studies.reality_gap.options import StandIns
from swarmtwin.studies.reality_gap.same_starts import roll_out_everywhere, stand_in_motions
from swarmtwin.world.rollout import RolloutFigures, figures_of
from swarmtwin.world.task import Task


class SeedTrial(NamedTuple):
    """What came of one seed.

    Attributes:
        result: of learning.
        cpu_s: processor time that learning took, its evaluations included, s; None where it went on after a break.
        figures: of the roll-outs by which nothing was chosen, in the simulation and on each group of stand-ins; empty
            where training diverged before the first evaluation.
    """

    result: SeedResult
    cpu_s: float | None
    figures: dict[str, RolloutFigures]


@dataclass(frozen=True)
class SeedJob:
    """One seed to learn with and to try.

    Attributes:
        learning: how it is learned.
        task: that it learns, as it is done in the simulation's arena.
        origin: what the simulation is.
        stand_ins: groups that it is tried on, by name.
        rollouts: on each of them, from the same starts for all seeds.
        start_seed: of these starts.
        folder: where its policy is left; nothing is, where it has failed.
    """

    learning: PolicyJob
    task: Task
    origin: SimulationOrigin
    stand_ins: Mapping[str, StandIns]
    rollouts: int
    start_seed: int
    folder: Path

    def run(self, report: Report | None) -> SeedTrial:
        """Learn, going on from the checkpoint if there is one, save the policy and roll it out.

        Raises:
            UserError: the policy gives a command, or the simulation a displacement, that is not finite.
        """
        checkpoint = self.learning.checkpoint
        begins = checkpoint is None or not checkpoint.exists()
        began = time.process_time()
        result = self.learning.run(report)
        cpu_s = time.process_time() - began if begins else None
        if not result.weights:
            return SeedTrial(result, cpu_s, {})
        policy = policy_of(self.task, self.learning.algorithm, result)
        if not result.failed:
            self.folder.mkdir(parents=True)
            provenance = provenance_of(self.learning, [result], self.origin)
            save_policy(self.folder, policy, self.task.config, self.task.arena, provenance)
        rollouts = {SIMULATION: tested(self.task, self.learning, policy)}
        motions = stand_in_motions(self.stand_ins, self.task, self.rollouts, self.start_seed)
        scenario = draw_scenarios(self.task, self.rollouts, "rollout", self.start_seed)
        rollouts |= roll_out_everywhere(self.task, scenario, motions, lambda: policy.act)
        return SeedTrial(result, cpu_s, {where: figures_of(rollout) for where, rollout in rollouts.items()})
