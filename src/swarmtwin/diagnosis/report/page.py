"""The report of a diagnosis: one page that loads nothing, its pictures inside and also beside it."""

import base64
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from swarmtwin.diagnosis.report import sentences
from swarmtwin.diagnosis.report.posterior_plot import posterior_figure
from swarmtwin.diagnosis.report.residual_fields import blocks_of, components, field_choices
from swarmtwin.diagnosis.report.residual_plots import (
    AFTER,
    BEFORE,
    calm_figure,
    field_figure,
    runs_figure,
    spread_figure,
)
from swarmtwin.diagnosis.report.sentences import COMPONENTS, QUESTIONS, SHAPES, SPACE
from swarmtwin.diagnosis.result import DiagnosisResult, Gain
from swarmtwin.diagnosis.saved_diagnosis import SavedDiagnosis
from swarmtwin.simulation.mechanism import mechanism_class

PICTURE_OF = {
    "position": "place",
    "wall_distance": "place",
    "pose": "place",
    "elapsed_s": "time",
    "duration_s": "duration",
    "tails": "spread",
}
CALM_PICTURES = ("place", "heading", "time")
CAPTIONS = {
    "command": "Error over the commands",
    "previous_command": "Error over the change of the command",
    "place": "Error over the place in the arena (arrows: where it is carried to, if that is more than chance)",
    "heading": "Error over the heading",
    "time": "Error over the session",
    "duration": "Error over the length of the control period",
    "neighbours": "Error over the distance to the nearest vehicle",
    "vehicle": "Error vehicle by vehicle",
    "spread": "How large the errors are, beside the ordinary noise, of which 0.3 % is beyond ±3",
    "calm": "Errors over the place, the heading and the session: no more on average than chance makes",
    "calm_beside_units": "Errors beyond what vehicles have of their own, over the place, the heading and the session: "
    "no more on average than chance makes",
    "posterior": "Posterior probability of each set of causes, among all sets that were fitted",
    "runs": "Whole runs that nothing was fitted to, predicted from the first pose and the commands alone: a typical "
    "one and a bad one",
}


class Picture(NamedTuple):
    """A picture on the page: its file's name without ending, its caption, and its PNG."""

    name: str
    caption: str
    png: bytes

    @property
    def source(self) -> str:
        """The picture's content for a page that loads nothing."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode()}"


class Bars(NamedTuple):
    """One error before and after the extension, as bars: lengths in percent of the row.

    Attributes:
        title: which error.
        before: with its unit; "not known" where no run could be predicted.
        after: likewise; None where nothing was extended.
        before_length: of its bar.
        after_length: of its bar.
        interval: where the 95 % interval of the error afterwards begins and how long it is.
        change: by how much the error shrank, with its interval.
    """

    title: str
    before: str
    after: str | None
    before_length: float
    after_length: float
    interval: tuple[float, float]
    change: str


class WindowRow(NamedTuple):
    """Errors of positions over windows of one length in open loop, as a row of a table.

    Attributes:
        window: the length.
        before: mean ± standard deviation over windows, with the simulation as it was.
        extended: likewise, with the extended one; None where nothing was extended.
        change: by how much the mean shrank, with its interval.
        measured: over how many windows, of how many runs.
    """

    window: str
    before: str
    extended: str | None
    change: str
    measured: str


def draw_diagnosis(made: Path, output: Path) -> None:
    """Write the report of what `swarmtwin diagnose` left in `made` into `output`.

    Raises:
        UserError: a file that it is made of is missing or damaged.
    """
    write_report(output, SavedDiagnosis.read(made))


def write_report(folder: Path, diagnosed: SavedDiagnosis) -> None:
    """Write `report.html` and `figures/*.png` into an existing folder."""
    (folder / "figures").mkdir(exist_ok=True)
    pictures = []
    for name, (caption, figure) in _figures(diagnosed).items():
        file = folder / "figures" / f"{name}.png"
        figure.savefig(file, dpi=150, facecolor="white")
        pictures.append(Picture(name, caption, file.read_bytes()))
    (folder / "report.html").write_text(_page(diagnosed, pictures))


def leading_pictures(diagnosis: DiagnosisResult) -> list[str]:
    """Return the names of the pictures that show where it is, the most telling first; some may not have been drawn.

    First what the named causes look at, then what else the error depends on, its spread last.
    """
    if diagnosis.verdict == "no_gap":
        return ["calm"]
    explained = {test.part: test.explained for test in diagnosis.tests}
    parts = sorted(diagnosis.depends_on, key=lambda part: (part in SHAPES, -explained.get(part, 0.0)))
    shown = list(dict.fromkeys(PICTURE_OF.get(part, part) for part in parts))
    looked_at = [
        PICTURE_OF.get(part, part) for cause in diagnosis.causes for part in mechanism_class(cause.name).inputs
    ]
    leading = list(dict.fromkeys([*(name for name in looked_at if name in shown), *shown]))
    return leading[:2]


def _figures(diagnosed: SavedDiagnosis) -> dict[str, tuple[str, Figure]]:
    """Draw all pictures by name, with their captions.

    Residual fields show all transitions; where a residual was learned, only those that it was not learned from.
    """
    extension = diagnosed.result.extension
    learned, extended = "learned_residual" in extension, extension != "none"
    rows = diagnosed.held_out if learned and diagnosed.held_out.any() else np.ones(len(diagnosed.transitions), bool)
    transitions = diagnosed.transitions.where(rows)
    residuals = {BEFORE: diagnosed.residual_before[rows]}
    if extended:
        residuals[AFTER] = diagnosed.residual_after[rows]
    simulated = diagnosed.simulated[rows]
    parts = {title: components(transitions, simulated, residual) for title, residual in residuals.items()}
    block, arena = blocks_of(transitions), transitions.arena_mm
    choices = field_choices(transitions, parts[BEFORE])
    drawn = {
        name: (f"{CAPTIONS[name]}: {COMPONENTS[choice.component]}", field_figure(choice, parts, block, arena))
        for name, choice in choices.items()
    }
    drawn["spread"] = CAPTIONS["spread"], spread_figure(residuals)
    calm = [choices[name] for name in CALM_PICTURES if name in choices]
    if diagnosed.result.verdict == "no_gap" and calm:
        caption = CAPTIONS["calm_beside_units" if diagnosed.result.units else "calm"]
        drawn["calm"] = caption, calm_figure(calm, parts[BEFORE], block)
    further = {
        "posterior": posterior_figure(diagnosed.result.posterior),
        "runs": runs_figure(diagnosed.runs_before, diagnosed.runs_after if extended else ()),
    }
    return drawn | {name: (CAPTIONS[name], figure) for name, figure in further.items() if figure}


def _page(diagnosed: SavedDiagnosis, pictures: list[Picture]) -> str:
    diagnosis, robot = diagnosed.result, diagnosed.transitions.robot
    drawn = {picture.name: picture for picture in pictures}
    leading = [drawn[name] for name in leading_pictures(diagnosis) if name in drawn]
    environment = Environment(
        loader=PackageLoader("swarmtwin.diagnosis.report", "."),
        undefined=StrictUndefined,
        autoescape=True,
        trim_blocks=True,
    )
    return environment.get_template("page.html.jinja").render(
        diagnosis=diagnosis,
        robot=robot,
        words=sentences,
        questions=QUESTIONS,
        bars=gain_bars(diagnosis),
        noise=noise_words(diagnosed),
        windows=window_rows(diagnosis, 10 * robot.period_s if diagnosis.gain.ten_periods_mm else None),
        leading=leading,
        posterior=drawn.get("posterior"),
        runs=drawn.get("runs"),
        others=[
            picture for picture in pictures if picture not in leading and picture.name not in ("posterior", "runs")
        ],
    )


def gain_bars(diagnosis: DiagnosisResult) -> list[Bars]:
    """Return the errors as bars."""
    gain = diagnosis.gain
    bars = {
        "position after one period": (gain.position_mm, "mm"),
        "heading after one period": (gain.orientation_deg, "°"),
        "position over ten periods": (gain.ten_periods_mm, "mm"),
        "position over whole runs": (gain.open_loop_mm, "mm"),
    }
    return [_bars(title, one, unit, diagnosis) for title, (one, unit) in bars.items() if one]


def noise_words(diagnosed: SavedDiagnosis) -> str:
    """Return how large the errors of one period are on held-out runs, in standard deviations of the ordinary noise."""
    rows = diagnosed.held_out
    if not rows.any():
        return ""
    residuals = [diagnosed.residual_before] + [diagnosed.residual_after] * (diagnosed.result.extension != "none")
    sizes = [f"{np.sqrt(np.nanmean(residual[rows] ** 2)):.2f}" for residual in residuals]
    return (
        f"In standard deviations of the ordinary noise, of position and heading together, errors after one period are "
        f"{' → '.join(sizes)} (root mean square; noise alone: 1)."
    )


def window_rows(diagnosis: DiagnosisResult, but_s: float | None = None) -> list[WindowRow]:
    """Return open loop over windows as rows of a table; none where no run was long enough, or in older results.

    Args:
        diagnosis: whose errors.
        but_s: length of windows that are left out, since they are told elsewhere.
    """
    rows = []
    for one in diagnosis.gain.open_loop_windows:
        if but_s and math.isclose(one.window_s, but_s):
            continue
        decimals = _decimals(one.before)
        before, after = (
            f"{mean:.{decimals}f} ± {spread:.{decimals}f}{SPACE}mm"
            for mean, spread in ((one.before, one.before_sd), (one.after, one.after_sd))
        )
        rows.append(
            WindowRow(
                window=f"{one.window_s:g}{SPACE}s",
                before=before,
                extended=after if diagnosis.extension != "none" else None,
                change=sentences.gain_words(one, "mm"),
                measured=f"{one.pieces} from {one.runs} runs",
            )
        )
    return rows


def _decimals(error: float) -> int:
    """Return how many decimals leave an error three digits, three at most."""
    return min(max(0, 2 - math.floor(math.log10(error))), 3) if error > 0 else 0


def _bars(title: str, gain: Gain, unit: str, diagnosis: DiagnosisResult) -> Bars:
    low, high = max(gain.before - gain.high, 0.0), max(gain.before - gain.low, 0.0)
    full = max(gain.before, gain.after, high) or 1.0
    decimals = _decimals(gain.before)
    before, after = (
        f"{value:.{decimals}f}{SPACE}{unit}".replace(f"{SPACE}°", "°") for value in (gain.before, gain.after)
    )
    return Bars(
        title=title,
        before=before if gain.before > 0 else "not known",
        after=after if gain.before > 0 and diagnosis.extension != "none" else None,
        before_length=100 * gain.before / full,
        after_length=100 * gain.after / full,
        interval=(100 * low / full, 100 * (high - low) / full),
        change=sentences.gain_words(gain, unit).replace(f"{SPACE}°", "°"),
    )
