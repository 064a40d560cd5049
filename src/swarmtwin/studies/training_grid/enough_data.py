"""How little real data is enough: from how few real transitions a model errs no more than from all of them."""

from collections.abc import Iterator

from swarmtwin.robot import StrictModel
from swarmtwin.studies.training_grid.claims import Errors
from swarmtwin.studies.training_grid.comparison import HOLDS, Judging, compare
from swarmtwin.studies.training_grid.trainings import Training


class EnoughData(StrictModel):
    """What is known of one way to learn.

    Attributes:
        model: the dynamics model.
        generator: what its transitions are drawn from; None: it learns from the real ones directly.
        equal: steps or epochs.
        tried: numbers of real transitions that were tried, ascending.
        fewest: the smallest of them from which on, with all larger ones, the error is not worse than of the same model
            on all real transitions, by more than the margin, measurably; None: of none.
        real: how many real transitions there are in all.
    """

    model: str
    generator: str | None
    equal: str
    tried: tuple[int, ...]
    fewest: int | None
    real: int

    @property
    def sentence(self) -> str:
        """Say it."""
        way = f"{self.model} on real transitions, equal {self.equal}"
        if self.generator:
            way = f"{self.model} on transitions of generator {self.generator}"
        tried = ", ".join(f"{count:,}" for count in self.tried)
        if self.fewest is None:
            return f"{way}: as good as {self.model}-R on all {self.real:,} from none of {tried} real transitions"
        share = self.fewest / self.real
        return f"{way}: as good as {self.model}-R on all {self.real:,} from {self.fewest:,} ({share:.0%}), of {tried}"


def enough_data(errors: Errors, real: int, judging: Judging, recording: str = "other_vehicle") -> Iterator[EnoughData]:
    """Yield what is known of each way to learn of which several amounts of real transitions were tried.

    Args:
        errors: of all trainings made.
        real: how many real transitions there are.
        judging: how comparisons are judged.
        recording: the errors on which are compared.
    """
    ways: dict[Training, list[Training]] = {}
    for training in errors:
        ways.setdefault(training.model_copy(update={"real": 1.0}), []).append(training)
    for way, amounts in ways.items():
        reference = Training(model=way.model, learning_rate=way.learning_rate, steps=way.steps)
        plain = Training(**{**reference.model_dump(), "generator": way.generator, "equal": way.equal})
        if reference not in errors or way != plain or len(amounts) < 2:
            continue
        enough: list[Training] = []
        for training in sorted(amounts, key=lambda one: -one.real):
            if training.generator or training.real < 1:
                found = compare(
                    errors[training].get(recording, {}), errors[reference].get(recording, {}), "position_mm", judging
                )
                if found is None or found.verdict("not_worse", judging) != HOLDS:
                    break
            enough.append(training)
        yield EnoughData(
            model=way.model,
            generator=way.generator,
            equal=way.equal,
            tried=tuple(round(one.real * real) for one in sorted(amounts, key=lambda one: one.real)),
            fewest=round(enough[-1].real * real) if enough else None,
            real=real,
        )
