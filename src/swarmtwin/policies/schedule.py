"""How long a policy is learned, how often it is looked at, and how many times learning begins."""

from typing import Annotated, Self

from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.robot import StrictModel

Count = Annotated[int, Field(ge=1)]


class Schedule(StrictModel):
    """How long to learn, and how often to look how well.

    Attributes:
        steps: control periods of all worlds.
        evaluate_every: control periods from one evaluation and checkpoint to the next.
        scenes: scenarios in which each evaluation rolls the policy out, the same ones for every seed.
        finalists: how many of a seed's policies, those that did best in an evaluation, are rolled out once more in the
            end: who was best of many in few scenarios was lucky as well.
        final_scenes: the scenarios in which, again the same ones for every seed.
        starts: how many times each seed begins anew, with other networks, scenarios and noise. What a policy has found
            early decides much of what it ends as, so that one of several is a better beginning than any one.
        start_steps: control periods after which the start with the highest reward goes on alone; of no account
            where there is but one.
    """

    steps: Count
    evaluate_every: Count
    scenes: Count
    finalists: Count = 3
    final_scenes: Count = 500
    starts: Count = 1
    start_steps: Count = 3000

    @property
    def all_steps(self) -> int:
        """Control periods of all worlds that a seed learns for, with those of the starts that were given up."""
        return self.steps + (self.starts - 1) * self.start_steps

    @classmethod
    def of(cls, options: StrictModel, steps: int) -> Self:
        """Return the schedule that options of a command ask for, which have fields of the same names but `steps`.

        Raises:
            UserError: the starts leave no steps to the one that goes on.
        """
        schedule = cls(steps=steps, **options.model_dump(include=cls.model_fields.keys() - {"steps"}))
        if schedule.starts > 1 and schedule.start_steps >= steps:
            raise UserError(
                f"start_steps: each of {schedule.starts} starts learns for {schedule.start_steps} control periods, and "
                f"policy.steps={steps} leaves none to the one that goes on: lower start_steps, or raise policy.steps"
            )
        return schedule
