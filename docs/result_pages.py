"""The pages of results, from what the pipelines computed and pushed: nothing on them is typed."""

from pathlib import Path

import yaml

from swarmtwin.diagnosis.report.page import gain_bars, window_rows
from swarmtwin.diagnosis.report.sentences import estimate_words, parameter_title
from swarmtwin.diagnosis.result import DiagnosisResult, EstimatedCause
from swarmtwin.studies.study_table import StudyTable

REPOSITORY = Path(__file__).resolve().parents[1]
TABLES = REPOSITORY / "artifacts" / "tables"
RESULTS = REPOSITORY / "docs" / "results"
EXPERIMENTS = {  # navigation's title of the pages that experiments wrote: where their folders lie
    "The paper's tables and figures": "paper",
    "All models": "models",
    "All generators": "generators",
    "Policies of ten seeds": "policy_seeds",
    "Policies in several simulations": "reality_gap",
    "Real robots": "creates",
}


def pipeline_page() -> str:
    """Return the tables of `make run` as the pipeline's lock has them.

    Raises:
        FileNotFoundError: they were not pulled.
    """
    pipeline = yaml.safe_load((REPOSITORY / "conf" / "pipeline.yaml").read_text())
    seeds = pipeline["seeds"]
    about = (
        "These are the tables that the pipeline made last. It trains "
        f"{'one seed' if seeds == 1 else f'{seeds} seeds'} of each model, so that its tables show whether everything "
        "works, and not which model is best: [several seeds of each, with intervals](models/mgr/report.md), are "
        "experiments of their own. Errors are those of runs that no model has seen."
    )
    tables = [(TABLES / robot / "tables.md").read_text() for robot in pipeline["robots"]]
    return "\n\n".join(["# What `make run` shows", about, *tables])


def creates_page() -> str:
    """Return what was diagnosed of the real robots, each against a simulation of others.

    Raises:
        FileNotFoundError: it was not pulled.
    """
    found = {
        folder.name.removeprefix("robot_"): DiagnosisResult.model_validate_json((folder / "diagnosis.json").read_text())
        for folder in sorted((RESULTS / "creates").glob("robot_*"))
    }
    causes = StudyTable(
        "What was found",
        ("robot", "transitions", "verdict", "likeliest set", "its values (95 % interval)", "held-out runs"),
        [
            [
                robot,
                f"{one.transitions['used']:,}",
                one.verdict,
                _likeliest(one),
                ",\n".join(map(_cause_words, one.likeliest)) or "none",
                one.not_confirmed
                or one.not_registered
                or ("" if one.extension == "none" else "confirm it: registered"),
            ]
            for robot, one in found.items()
        ],
        "the likeliest causes are named only where held-out runs confirm them and nothing of note is left, which is "
        "where the verdict is explained; those that may as well do nothing have no values",
        left=(2, 3, 4, 5),
    )
    bars = {robot: gain_bars(one) for robot, one in found.items()}
    gains = StudyTable(
        "What the extended simulation gains",
        ("robot", *(bar.title for bar in next(iter(bars.values())))),
        [
            [robot, *(f"{bar.before} → {bar.after}\n{bar.change}" if bar.after else bar.before for bar in own)]
            for robot, own in bars.items()
        ],
        "errors on held-out runs with the simulation as it was and as it is extended, by causes or a learned residual, "
        "and below the change with its 95 % interval",
    )
    return "\n\n".join(
        [
            "# Diagnosis of real robots",
            "Five iRobot Creates of [MR.CLAM](https://doi.org/10.1177/0278364911398404), data set 6. A simulation was "
            "learned from robot 1 and given the command alone, so that memory of earlier commands counts as a gap; "
            "robots 2 to 5 were each diagnosed against it, and robot 1 against one that was learned from these four. "
            "With the data set at hand, "
            "`MRCLAM=DIR dvc repro docs/results/creates/dvc.yaml` computes this page and [the tables beside "
            "it](models/report.md) anew.",
            causes.markdown(),
            gains.markdown(),
            *(table.markdown() for table in _windows(found)),
        ]
    )


def _windows(found: dict[str, DiagnosisResult]) -> list[StudyTable]:
    """Return errors of positions over seconds in open loop, robot by robot; no table of older results."""
    rows = [
        [robot, row.window, row.before, row.extended or "", row.change, row.measured]
        for robot, one in found.items()
        for row in window_rows(one)
    ]
    table = StudyTable(
        "What it gains in open loop",
        ("robot", "over", "before", "extended", "change", "predictions"),
        rows,
        "root mean square errors of positions over windows of held-out runs, each predicted from a measured pose and "
        "the commands alone: mean ± standard deviation over windows, with the simulation as it was and as it is "
        "extended, and the change of the mean with its 95 % interval",
    )
    return [table] if rows else []


def _likeliest(found: DiagnosisResult) -> str:
    likeliest = max(found.posterior, key=lambda one: one.probability)
    return f"{', '.join(likeliest.causes) or 'nothing'} ({likeliest.probability:.0%})"


def _cause_words(cause: EstimatedCause) -> str:
    form = f" ({', '.join(cause.form.values())})" if cause.form else ""
    values = [f"{parameter_title(name)} {estimate_words(name, one)}" for name, one in cause.parameters.items()]
    return f"{cause.name}{form}: {', '.join(values)}"


def experiment_entries() -> list[dict[str, list[dict[str, str]]]]:
    """Return the navigation's entries of the pages that experiments wrote: tables before figures, by their numbers."""
    return [
        {title: [_entry(page) for page in sorted((RESULTS / folder).glob("*/report.md"), key=_place)]}
        for title, folder in EXPERIMENTS.items()
    ]


def _entry(report: Path) -> dict[str, str]:
    """Return the entry of a page that an experiment wrote; the robot's name where its title leaves it open."""
    title, _, robot = report.read_text().partition("\n")[0].removeprefix("# ").partition(": ")
    shown = title if report.parent.parent.name == "paper" else f"{title}, {robot}"
    return {shown: report.relative_to(RESULTS.parent).as_posix()}


def _place(report: Path) -> tuple[bool, int, str]:
    name = report.parent.name
    return name.startswith("figure"), int("0" + "".join(sign for sign in name if sign.isdigit())), name
