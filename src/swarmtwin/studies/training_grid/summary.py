"""What an experiment on a grid of trainings found: the content of its metrics.json, which `name=findings` collects."""

from collections.abc import Sequence

from swarmtwin.robot import StrictModel
from swarmtwin.studies.training_grid.claims import Errors, JudgedClaim, judge
from swarmtwin.studies.training_grid.enough_data import EnoughData, enough_data
from swarmtwin.studies.training_grid.options import Options
from swarmtwin.studies.training_grid.training_jobs import MeasuredTrainingJob


class Summary(StrictModel):
    """The content of metrics.json.

    Attributes:
        name: of the experiment.
        title: of it, the table or figure of the paper.
        robot: whose transitions.
        source: where its recording comes from, in its own words: a stand-in or a robot.
        scale: how large it was.
        recipe: how models were trained.
        seeds: runs of each training.
        real: how many real transitions there were to learn from.
        trainings: runs that it rests on, all seeds counted.
        training_s: seconds that these took, whenever that was, one after the other.
        taken_s: seconds that this call spent on those that were not in the store.
        claims: of the paper, judged.
        enough: how little real data is enough, where several amounts were tried.
    """

    name: str
    title: str
    robot: str
    source: str
    scale: str
    recipe: str
    seeds: int
    real: int
    trainings: int
    training_s: float
    taken_s: float
    claims: tuple[JudgedClaim, ...]
    enough: tuple[EnoughData, ...]

    @property
    def about(self) -> str:
        """What was done, in a sentence."""
        return (
            f"{self.trainings} trainings ({self.seeds} seeds of each) with {self.real:,} real transitions to learn "
            f"from, of robot {self.robot} ({self.source}), scale {self.scale}, recipe {self.recipe}: "
            f"{self.training_s / 60:.1f} minutes of training on one core, of which this call spent "
            f"{self.taken_s / 60:.1f} minutes on those that were not in the store."
        )


def summarise(options: Options, jobs: Sequence[MeasuredTrainingJob], errors: Errors, taken_s: float) -> Summary:
    """Judge the claims of an experiment by the errors of its trainings.

    Args:
        options: of the experiment.
        jobs: all of them, done.
        errors: by run, of each training.
        taken_s: what this call spent on them.
    """
    real = jobs[0].data.count
    judged = (judge(claim, errors, real, options.judging) for claim in options.claims)
    return Summary(
        name=options.name,
        title=options.title,
        robot=options.robot.name,
        source=jobs[0].data.real[1].source,
        scale=options.scale,
        recipe=options.recipe.name,
        seeds=options.size.seeds,
        real=real,
        trainings=len(jobs),
        training_s=sum(job.store.outcome(job.key).seconds for job in jobs),
        taken_s=taken_s,
        claims=tuple(claim for claim in judged if claim),
        enough=tuple(enough_data(errors, real, options.judging)),
    )
