"""The picture of how sure a diagnosis is: the probability of the leading sets of causes, as bars."""

import textwrap
from collections.abc import Sequence

from matplotlib.figure import Figure

from swarmtwin.diagnosis.report.sentences import cause_set_title, probability_words
from swarmtwin.diagnosis.result import CauseSet
from swarmtwin.plotting import FLOOR, PREDICTED, style

WIDTH_INCHES = 6.8
LABEL_CHARACTERS = 34


def shown_sets(posterior: Sequence[CauseSet], most: int = 8, least: float = 0.001) -> list[CauseSet]:
    """Return the sets that a picture shows, the most probable first.

    They are those with a probability of `least` and more, at most `most` of them; the best one has the next one beside
    it, however improbable, and that nothing is wrong is always among them where that was weighed.
    """
    leading = [one for number, one in enumerate(posterior) if one.probability >= least or number < 2][:most]
    nothing = [one for one in posterior if not one.causes and one not in leading]
    return [*leading[: most - len(nothing)], *nothing]


def posterior_figure(posterior: Sequence[CauseSet]) -> Figure | None:
    """Draw the probability of the leading sets of causes as bars, the most probable on top; None where none is kept."""
    sets = shown_sets(posterior)
    if not sets:
        return None
    labels = [textwrap.fill(cause_set_title(one.causes), LABEL_CHARACTERS) for one in sets]
    lines = sum(label.count("\n") + 1 for label in labels)
    with style():
        figure = Figure(figsize=(WIDTH_INCHES, 0.55 + 0.12 * len(sets) + 0.17 * lines), layout="constrained")
        panel = figure.subplots()
        places = range(len(sets))
        colours = [PREDICTED if one.causes else FLOOR for one in sets]
        panel.barh(places, [100 * one.probability for one in sets], height=0.62, color=colours)
        for place, one in zip(places, sets, strict=True):
            panel.annotate(
                probability_words(one.probability),
                (100 * one.probability, place),
                (4, 0),
                textcoords="offset points",
                va="center",
            )
        panel.set_yticks(places, labels, parse_math=False)
        panel.tick_params(axis="y", length=0)
        panel.grid(visible=False, axis="y")
        panel.invert_yaxis()
        panel.set(xlim=(0, 112), xticks=range(0, 101, 25), xlabel="probability, %")
        panel.spines["bottom"].set_bounds(0, 100)
    return figure
