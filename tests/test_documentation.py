"""What the README and the documentation say is so: code runs, commands are understood, links lead somewhere."""

import functools
import itertools
import json
import operator
import os
import re
import subprocess
import sys
from pathlib import Path

import hydra
import numpy as np
import pandas as pd
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob

from documentation import DOCS, PAGES, README, REPOSITORY, blocks, commands
from swarmtwin.commands.app import _spelled_out
from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.configuration import config_files, config_folder, let_hydra_find_plugins
from swarmtwin.diagnosis.names_in_trials import NAMED_IN_TRIALS
from swarmtwin.robot import Robot
from swarmtwin.standin.physics import fabricate
from swarmtwin.standin.rigid_body.car import Car
from swarmtwin.standin.robots.mgr import MgrUnit
from swarmtwin.studies.hidden_effects.results import Result
from swarmtwin.studies.hidden_effects.sessions import measured_session, reference_session
from swarmtwin.world.rollout import Rate
from test_outside import WAY
from tiny_policies import robot_named, simulation

OUTSIDE = REPOSITORY / "tests" / "outside"
CALLS = [(page, call) for page in PAGES for call in commands(page)]


def test_the_python_in_the_pages_runs_in_a_folder_as_make_run_leaves_it(workplace):
    simulation(workplace / "artifacts" / "dynamics" / "mgr" / "crnet_synthetic", robot_named("mgr"))
    page = DOCS / "policies-and-worlds.md"
    names: dict = {}
    for block in blocks(page, "python"):
        exec(compile(block, str(page), "exec"), names)
    assert all(names["terminated"].values()) or all(names["truncated"].values())
    assert names["env"].agents == []


def test_all_python_in_the_pages_is_run_here_or_as_a_plug_in():
    elsewhere = [page for page in PAGES if blocks(page, "python") and page.parent.name != "extending"]
    assert elsewhere == [DOCS / "policies-and-worlds.md"]


@pytest.fixture(scope="module")
def rover(tmp_path_factory):
    """A folder of one's own, with the robot that a page tells how to write."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "robot").mkdir()
    (block,) = blocks(DOCS / "your-own-robot.md", "yaml")
    (folder / "robot" / "rover.yaml").write_text(block)
    return folder


def test_the_robot_that_a_page_describes_can_be_read(rover):
    assert Robot.load(rover / "robot" / "rover.yaml").actuation.track_mm == 120


def first_of_a_sweep(argument):
    (override,) = OverridesParser.create().parse_overrides([argument])
    if not override.is_sweep_override():
        return argument
    group, chosen = override.key_or_group, override.value()
    values = (
        chosen.filter(sorted(config_files(group))) if isinstance(chosen, Glob) else override.sweep_string_iterator()
    )
    return f"{group}={next(iter(values))}"


@pytest.mark.parametrize(
    "page", PAGES, ids=lambda page: page.stem if page.parent == DOCS else page.parent.name + "-" + page.stem
)
def test_every_command_in_a_page_is_understood(page, rover, monkeypatch):
    """Hydra composes its configuration: command, options and choices exist."""
    monkeypatch.setenv("SWARMTWIN_PLUGINS", str(OUTSIDE))
    let_hydra_find_plugins()
    for name, *arguments in commands(page):
        if name.startswith("-") or "--help" in arguments:
            continue
        assert name in COMMANDS, name
        said = [argument for argument in _spelled_out(name, arguments) if not argument.startswith("-")]
        said = [first_of_a_sweep(argument) for argument in said]
        config = name
        if name == "experiment":
            config = "experiment/" + next(one for one in said if one.startswith("name=")).partition("=")[2]
        if "--config-dir=mine" in arguments:
            said.append(f"hydra.searchpath=[file://{rover}]")
        with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
            assert hydra.compose(config, said), (name, said)


def test_commands_are_found_in_the_pages():
    assert len(CALLS) > 60
    assert len({call[0] for _, call in CALLS}) >= 15


def test_the_pages_on_extending_show_every_plug_in_of_the_test_and_its_commands():
    shown = [path for page in DOCS.glob("extending/*.md") for path in re.findall(r'--8<-- "(.*?)"', page.read_text())]
    there = [file for file in OUTSIDE.rglob("*") if file.suffix in (".py", ".yaml")]
    assert sorted(shown) == sorted(str(file.relative_to(REPOSITORY)) for file in there)
    tested = [set(line.split()) for line in WAY.strip().splitlines()]
    for page in sorted(DOCS.glob("extending/*.md")):
        for call in commands(page):
            assert "--help" in call or any(set(call) <= line for line in tested), (page.name, call)


def test_the_readme_is_short_and_begins_with_a_picture():
    lines = README.read_text().splitlines()
    assert len(lines) < 150
    assert "](docs/images/group.gif)" in "".join(lines[:6])
    assert (DOCS / "images" / "group.gif").stat().st_size < 500_000


def test_what_the_readme_says_of_models_is_what_they_were_measured_with():
    for robot, models in {"mgr": ("crnet-R", "mlp-R"), "mur": ("crnet-R", "kinematic-R")}.items():
        file = DOCS / "results" / "models" / robot / "table.csv"
        if not file.is_file():
            pytest.skip("no docs/results/models: dvc pull docs/results/dvc.yaml")
        table = pd.read_csv(file).query("recording == 'train_vehicle'").set_index("title")
        figures = [*table.position_mm[list(models)], table.floor_command_position_mm.iloc[0]]
        (row,) = [line for line in README.read_text().splitlines() if re.match(rf"\|.*\b{robot.upper()}\b.*mm", line)]
        assert re.findall(r"[\d.]+(?= mm)", row)[:3] == [f"{figure:.2f}" for figure in figures]
        limit = float(re.search(r"below ([\d.]+) mm", row)[1])
        assert (table.position_mm_over_seeds[list(models)] < limit).all()


def test_what_is_said_of_policies_is_what_ten_seeds_did():
    """The README's row, and the table of the results: least and most success in simulation and on stand-ins."""
    said = (DOCS / "results.md").read_text()
    for file in sorted((DOCS / "results" / "policy_seeds").glob("*/metrics.json")):
        found = json.loads(file.read_text())
        shares = [[100 * share for share in found["success"][of].values()] for of in ("simulation", "other_vehicles")]
        (row,) = re.findall(rf"^ *\| .*policy_seeds/{file.parent.name}/report.md.*$", said, re.MULTILINE)
        cells = [cell.strip() for cell in row.strip("| ").split("|")][1:]
        assert int(cells[2]) == found["seeds_as_asked"]
        for cell, own in zip(cells, shares, strict=False):
            least, most = f"{min(own):.1f}".removesuffix(".0"), f"{max(own):.1f}".removesuffix(".0")
            assert [one.removesuffix(".0") for one in re.findall(r"[\d.]+", cell)] == [least, most], (
                file.parent.name,
                cell,
            )
        if file.parent.name == "collective_room":
            (row,) = [line for line in README.read_text().splitlines() if "Five vehicles gather" in line]
            assert f"ten of ten seeds succeed in {min(shares[1]):.1f} to {max(shares[1]):.1f} %" in row
            chance = found["share_as_asked"]
            assert f"{100 * chance['low']:.0f} to {100 * chance['high']:.0f} %" in row


def test_what_is_said_of_policies_in_extended_simulations_is_what_was_measured():
    file = DOCS / "results" / "policy_gain" / "metrics.json"
    if not file.is_file():
        pytest.skip("no docs/results/policy_gain: dvc pull docs/results/dvc.yaml")
    found, said = json.loads(file.read_text()), (DOCS / "results.md").read_text()
    rows = {
        "lag of 0.5 s": "lag",
        "delay of 0.4 s": "delay",
        "two of five commands lost": "loss",
        "battery that sags to half the speed": "sag",
        "patch that takes 0.7 of the speed": "patch",
    }
    for row, hidden in rows.items():
        (line,) = [one for one in said.splitlines() if one.startswith(f"| {row} |")]
        cells = [cell.strip().replace("−", "-") for cell in line.split("|")[2:-1]]
        for (before, after, gain), family in zip((cells[:3], cells[3:]), ("formulas", "rigid_body"), strict=True):
            own = found[family][hidden]
            names = ("success_gain", "success_gain_low", "success_gain_high")
            value, low, high = (round(100 * own[name]) for name in names)
            assert (before, after) == (f"{100 * own['before_success']:.0f}", f"{100 * own['after_success']:.0f}")
            assert gain == f"{value} ({low} to {high})", (family, hidden)


def counted_of_the_diagnosis(what="families", page="hidden_effects"):
    """What the study of hidden effects counted in each family of stand-ins."""
    file = DOCS / "results" / page / "metrics.json"
    if not file.is_file():
        pytest.skip(f"no docs/results/{page}: dvc pull docs/results/dvc.yaml")
    return json.loads(file.read_text())[what]


def test_the_table_of_the_diagnosis_is_what_the_study_counted():
    rows = {
        "one effect that raises the error by 10 % or more: named, and nothing else": ("one", "10 % or more", "exact"),
        "the same: an alarm": ("one", "10 % or more", "found"),
        "one, 3 to 10 %": ("one", "3 to 10 %", "exact"),
        "one, below 3 %": ("one", "below 3 %", "exact"),
        "one, once to twice as large as its detection limit": ("limits", "once to twice"),
        "one, larger": ("limits", "twice or more"),
        "two: both, and nothing else": ("two", "exact"),
        "three: all, and nothing else": ("three", "exact"),
        "one that acts by another law: named, and nothing else": ("misspecified", "exact"),
        "the same: it alone is the likeliest": ("misspecified", "likeliest_true"),
        "one that acts by another law, error up by 10 % or more: named, and nothing else": (
            "misspecified",
            "exact_of_clear",
        ),
        "in no catalogue: a name given all the same": ("outside", "not_named"),
        "in no catalogue, error up by 10 % or more: alarm": ("outside", "costly_found"),
        "nothing wrong: an alarm": ("clean", "alarmed"),
        "nothing wrong: a cause named": ("clean", "accused"),
        "95 % intervals that hold the truth": ("covered",),
    }
    said = (DOCS / "results.md").read_text()
    for row, path in rows.items():
        (line,) = [one for one in said.splitlines() if one.startswith(f"| {row} |")]
        *cells, learned_from = [cell.strip() for cell in line.split("|")[2:5]]
        families = list(counted_of_the_diagnosis().values())
        for cell, own in zip(cells, families, strict=True):
            count = functools.reduce(operator.getitem, path, own)
            shown = count["total"] - count["count"] if path == ("outside", "not_named") else count["count"]
            assert cell == f"{shown} of {count['total']}", row
        if learned_from:
            known = (*path[:-1], "exact_of_known_vehicle")
            counts = [functools.reduce(operator.getitem, known, own) for own in families]
            assert learned_from == " of ".join(str(sum(one[name] for one in counts)) for name in ("count", "total")), (
                row
            )


def test_the_table_of_another_seed_is_what_the_study_counted():
    rows = {
        "one effect, error up by 10 % or more": ("one", "10 % or more", "exact"),
        "one effect, 3 to 10 %": ("one", "3 to 10 %", "exact"),
        "one effect, below 3 %": ("one", "below 3 %", "exact"),
        "two effects": ("two", "exact"),
        "three effects": ("three", "exact"),
        "one effect by another law": ("misspecified", "exact"),
        "something of no catalogue: a name given": ("outside", "not_named"),
        "the same, error up by 10 % or more: alarm": ("outside", "costly_found"),
        "clean: an alarm": ("clean", "alarmed"),
        "clean: a cause named": ("clean", "accused"),
        "intervals that hold the truth": ("covered",),
    }
    new, old = (list(counted_of_the_diagnosis(page=page).values()) for page in ("confirmation", "hidden_effects"))
    for row, path in rows.items():

        def shown(families, path=path):
            counts = [functools.reduce(operator.getitem, path, own) for own in families]
            total = sum(one["total"] for one in counts)
            count = sum(one["count"] for one in counts)
            return f"{total - count if path == ('outside', 'not_named') else count} of {total}"

        expected = [*(shown([own]) for own in new), shown([*new, *old])]
        assert cells_of_results(row)[:3] == expected, row
    assert cells_of_results("calibration error")[:2] == [f"{own['calibration_error']:.3f}" for own in new]
    by_chance = cells_of_results("the same, below that in 95 % of such studies if confidences are right")
    assert by_chance[:2] == [f"{own['calibration_error_by_chance']:.3f}" for own in new]
    scores = {
        "calibration error of posterior probabilities alone": "calibration_error_of_posterior",
        "mean squared error of confidences": "brier",
        "mean squared error of posterior probabilities alone": "brier_of_posterior",
    }
    for row, key in scores.items():
        assert cells_of_results(row)[:2] == [f"{own[key]:.3f}" for own in new], row


def test_how_sure_names_are_is_what_the_study_counted():
    text = " ".join((DOCS / "results.md").read_text().split())
    told = {
        "confidences miss that by {calibration_error:.3f}": "hidden_effects",
        "their confidences are {mean_confidence:.0%}": "confirmation",
        "confidences, of {mean_confidence:.0%}": "another_vehicle",
        "(they miss by {calibration_error:.3f}": "another_vehicle",
        "by less than {calibration_error_by_chance:.3f}": "another_vehicle",
        "Posterior probabilities miss by {calibration_error_of_posterior:.3f}": "another_vehicle",
    }
    for said, page in told.items():
        first, second = counted_of_the_diagnosis(page=page).values()
        number = said[said.index("{") :]
        both = f"{said.format(**first)} and {number.format(**second)}".replace("% and", " and").replace("%", " %")
        assert both in text, both
    judged = (DOCS / "results" / "judged" / "confirmation.jsonl").read_text().splitlines()
    named = [
        (one.name, one.name in case.true_causes)
        for case in map(Result.model_validate_json, judged)
        for one in case.causes
    ]
    bent = [there for name, there in named if name in ("dead_band", "gain_change")]
    others = [there for name, there in named if name not in ("dead_band", "gain_change")]
    said = f"says 77 %, {sum(bent)} of {len(bent)} are there, of the other causes {sum(others)} of {len(others)}"
    assert said in text


def test_the_table_of_another_vehicle_is_what_the_study_counted():
    """Sessions of another vehicle are those of any without those of the vehicle learned from."""
    families = [list(counted_of_the_diagnosis(page=page).values()) for page in ("hidden_effects", "another_vehicle")]
    rows = {
        "one effect of another vehicle, error up by 10 % or more": ("one", "10 % or more"),
        "the same, 3 to 10 %": ("one", "3 to 10 %"),
        "the same, below 3 %": ("one", "below 3 %"),
        "two effects of another vehicle": ("two",),
        "three effects of another vehicle": ("three",),
    }
    for row, path in rows.items():
        counts = [[functools.reduce(operator.getitem, path, own) for own in of_page] for of_page in families]
        expected = [
            " of ".join(
                str(sum(one["exact"][name] - one["exact_of_known_vehicle"][name] for one in of_page))
                for name in ("count", "total")
            )
            for of_page in counts
        ]
        assert cells_of_results(row) == expected, row
    clean = [[own["clean"]["accused_of_other_vehicle"] for own in of_page] for of_page in families]
    expected = [f"{sum(one['count'] for one in own)} of {sum(one['total'] for one in own)}" for own in clean]
    assert cells_of_results("nothing wrong with another vehicle: a cause named") == expected


def test_how_often_names_are_right_is_what_was_judged():
    judged = (DOCS / "results" / "judged" / "hidden_effects.jsonl").read_text().splitlines()
    counted = {}
    for one in map(Result.model_validate_json, judged):
        for cause in one.causes:
            there, named = counted.get(cause.name, (0, 0))
            counted[cause.name] = (there + (cause.name in one.true_causes), named + 1)
    assert counted == NAMED_IN_TRIALS


def test_what_is_named_of_another_vehicle_is_what_was_judged():
    beside_one, beside_five = (
        {
            (one.case.family, one.case.kind, one.case.seed): one
            for one in map(Result.model_validate_json, (DOCS / "results" / "judged" / file).read_text().splitlines())
        }
        for file in ("hidden_effects.jsonl", "another_vehicle.jsonl")
    )
    expected = []
    for judged in ({key: beside_one[key] for key in beside_five}, beside_five):
        assert not any(one.same_vehicle for one in judged.values())
        named = [cause.name in one.true_causes for one in judged.values() for cause in one.causes]
        expected.append(f"{named.count(False)} of {len(named)}")
    assert cells_of_results("causes named of another vehicle that are not there") == expected


def test_what_a_stricter_level_would_name_is_what_both_seeds_counted():
    pages = [counted_of_the_diagnosis("by_least_share", page=page) for page in ("hidden_effects", "confirmation")]
    rows = {
        "one effect, error up by 10 % or more: named, and nothing else": "one_of_clear",
        "two effects: both, and nothing else": "two",
        "three effects: all, and nothing else": "three",
        "in no catalogue: a name given": "outside",
    }
    for row, name in rows.items():
        levels = [[page[least][name] for page in pages] for least in ("0", "98", "99", "99.5", "99.9")]
        counts = [sum(one["count"] for one in level) for level in levels]
        expected = [f"{counts[0]} of {sum(one['total'] for one in levels[0])}", *map(str, counts[1:])]
        assert cells_of_results(row)[:-1] == expected, row


def test_the_table_of_other_methods_is_what_the_study_counted():
    methods = counted_of_the_diagnosis("methods")
    rows = {
        "the diagnosis": [methods[family]["diagnosis"] for family in methods],
        "parameter fitting": [methods[family]["parameter fitting"] for family in methods],
        "the largest correlation": [methods[family]["rules on correlations"] for family in methods],
        "`mujoco.sysid`": [None, counted_of_the_diagnosis("true_model")["rigid_body"]["mujoco.sysid"]],
    }
    for row, families in rows.items():
        expected = []
        for own in families:
            named = [*own["one"].values(), own["two"], own["three"]] if own else []
            unnamed = [own["outside"]["total"] - own["outside"]["count"], own["accused"]["count"]] if own else []
            expected += [
                f"{sum(one['count'] for one in named)} of {sum(one['total'] for one in named)}" if own else "",
                f"{sum(unnamed)} of {own['outside']['total'] + own['accused']['total']}" if own else "",
            ]
        assert cells_of_results(row) == expected, row


def test_the_table_of_the_oracle_is_what_the_study_counted():
    pages = ("hidden_effects", "confirmation")
    seeds = [counted_of_the_diagnosis("true_model", page=page)["formulas"] for page in pages]
    for row, method in {"the diagnosis beside it": "diagnosis", "an oracle": "oracle"}.items():
        own = [seed[method] for seed in seeds]
        by_kind = [
            [one for seed in own for one in seed["one"].values()],
            *([seed[kind] for seed in own] for kind in ("two", "three")),
        ]
        shares = [
            tuple(sum(one[what] for one in counts) for what in ("count", "total"))
            for counts in [[one for counts in by_kind for one in counts], *by_kind]
        ]
        unnamed = sum(seed["outside"]["total"] - seed["outside"]["count"] + seed["accused"]["count"] for seed in own)
        shares.append((unnamed, sum(seed["outside"]["total"] + seed["accused"]["total"] for seed in own)))
        assert cells_of_results(row) == [f"{count} of {total}" for count, total in shares], row


def cells_of_results(row):
    """What the one row of docs/results.md that begins so says."""
    (line,) = [one for one in (DOCS / "results.md").read_text().splitlines() if one.startswith(f"| {row} |")]
    return [cell.strip() for cell in line.split("|")[2:-1]]


def test_what_the_readme_says_of_the_diagnosis_is_what_the_study_counted():
    families = counted_of_the_diagnosis().values()
    pages = ("hidden_effects", "confirmation", "clean_sessions")
    with_clean = [own for page in pages for own in counted_of_the_diagnosis(page=page).values()]
    for of, counts in {
        "is named, and nothing else": [own["one"]["10 % or more"]["exact"] for own in families],
        "a cause is named, or an alarm raised": [own["clean"]["alarmed"] for own in with_clean],
    }.items():
        count, total = (sum(one[name] for one in counts) for name in ("count", "total"))
        rate = Rate.of(np.arange(total) < count)
        (row,) = [line for line in README.read_text().splitlines() if of in line]
        assert f"{count} of {total}" in row
        assert f"{100 * rate.low:.0f} to {100 * rate.high:.0f} %" in row
    pairs = [own["two"]["exact"] for own in families]
    said = f"of two effects at once {sum(one['count'] for one in pairs)} of {sum(one['total'] for one in pairs)}"
    assert said in README.read_text()
    other_seed = counted_of_the_diagnosis(page="confirmation").values()
    one = [own["one"]["10 % or more"] for own in other_seed]
    counts = [
        [own["exact"] for own in one],
        [own["exact_of_known_vehicle"] for own in one],
        [own["two"]["exact"] for own in other_seed],
    ]
    first, second, pairs = (
        " of ".join(str(sum(one[name] for one in own)) for name in ("count", "total")) for own in counts
    )
    assert f"{first}, {second} and {pairs}" in README.read_text()


def test_clean_sessions_that_were_given_a_cause_are_of_a_vehicle_whose_dead_band_is_larger():
    """As the README says; the rigid body's bearings rub more."""
    pages = ("hidden_effects", "confirmation", "clean_sessions")
    judged = [DOCS / "results" / "judged" / f"{name}.jsonl" for name in pages]
    lines = [line for file in judged for line in file.read_text().splitlines() if line.strip()]
    results = [Result.model_validate_json(line) for line in lines]
    accused = [one for one in results if one.case.kind == "clean" and one.causes]
    assert [cause.name for one in accused for cause in one.causes] == ["dead_band"] * 2
    for case in (one.case for one in accused):
        robot = Robot.load(REPOSITORY / "conf" / "robot" / f"{case.robot}.yaml")
        sessions = reference_session(case, robot), measured_session(case, robot).session
        learned, measured = (session.vehicles for session in sessions)
        if case.family == "formulas":
            bands = [MgrUnit.of(vehicles).dead_band_pwm for vehicles in (learned, measured)]
        else:
            factors = [fabricate("mgr/rigid_body", vehicles, Car.spreads) for vehicles in (learned, measured)]
            bands = [np.array([one["left_friction"], one["right_friction"]]) for one in factors]
        assert learned != measured
        assert (bands[1] > bands[0]).all()


@pytest.mark.parametrize(
    "page", [README, REPOSITORY / "DEPLOYMENT.md", REPOSITORY / "ARCHITECTURE.md"], ids=lambda page: page.stem
)
def test_links_of_files_at_the_top_lead_to_files_and_their_sections(page):
    for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if link.startswith("http"):
            continue
        path, _, section = link.partition("#")
        file = REPOSITORY / path
        assert file.exists(), link
        headings = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE) if section else []
        assert not section or section in {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}, (
            link
        )


def test_no_page_calls_the_outcome_of_a_single_seed_the_best():
    """The word is left for the best possible model, which is a bound."""
    for page in PAGES:
        words = " ".join(page.read_text().split())
        for said in re.findall(r".{0,40}\bbest\b.{0,40}", words):
            assert "best possible" in said or "is called the best" in said, (page.name, said)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The documentation, built strictly: a link, a section or a file that is not there is an error."""
    pytest.importorskip("mkdocs", reason="the documentation is built by `make docs`, which installs what it takes")
    shown = (
        DOCS / "results" / "findings",
        DOCS / "results" / "creates" / "table1",
        REPOSITORY / "artifacts" / "tables",
    )
    if missing := [folder for folder in shown if not folder.is_dir()]:
        pytest.skip(f"no {missing[0].relative_to(REPOSITORY)}: make docs fetches it")
    folder = tmp_path_factory.mktemp("documentation") / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    answer = subprocess.run(build, cwd=REPOSITORY, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return folder


SHOWN = {
    "index.html": "Record one cheap robot",
    "first-hour.html": "Watch a group drive",
    "results.html": "Micro-Underwater Robot",
    "diagnosing.html": "command_delay",
    "extending/mechanism.html": "wheels turn more slowly backwards",
    "notebooks/own_recording.html": "are they in metres?",
    "reference/commands/train.html": "real_share",
    "reference/configuration/robot.html": "differential_drive",
    "results/pipeline.html": "trained on real and on synthetic transitions",
    "results/models/mur/report.html": "an ensemble errs less than CR-Net",
    "results/creates/diagnosis.html": "command_delay: delay",
    "reference/code/simulation.html": "What a mechanism is: one stage of the signal chain",
    "changelog.html": "Unreleased",
}


@pytest.mark.claims
def test_the_documentation_loads_without_errors_and_shows_what_it_should(site, browser):
    for width, (path, said) in itertools.product((1280, 400), SHOWN.items()):
        page = browser.open(site / path, width)
        assert said in page.text(), path
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)"), path
        assert page.errors == [], path
        assert page.elsewhere() == [], path
        assert not page.is_wider_than_the_window(), path


@pytest.mark.claims
def test_the_documentation_can_be_searched_from_a_folder(site, browser):
    page = browser.open(site / "index.html")
    page.evaluate("document.querySelector('.md-search__input').focus()")
    page.evaluate(
        "(box => { box.value = 'battery_sag'; box.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}));"
        "box.dispatchEvent(new Event('input', {bubbles: true})); })(document.querySelector('.md-search__input'))"
    )
    page.wait_until("document.querySelectorAll('.md-search-result__item').length > 0")
    assert page.errors == []


@pytest.mark.claims
def test_the_reference_names_every_command_every_choice_and_every_module(site):
    for name in COMMANDS:
        assert name == "experiment" or (site / "reference" / "commands" / f"{name}.html").exists()
    for file in (REPOSITORY / "conf").rglob("*.yaml"):
        content = yaml.safe_load(file.read_text())
        group = file.parent.relative_to(REPOSITORY / "conf").as_posix()
        if group in (".", "experiment") or not isinstance(content, dict):
            continue
        shown = (site / "reference" / "configuration" / f"{group.replace('/', '-')}.html").read_text()
        assert f"{group}={file.stem}" in shown
    modules = list((REPOSITORY / "src" / "swarmtwin" / "simulation" / "mechanisms").glob("[a-z]*.py"))
    shown = (site / "reference" / "code" / "simulation-mechanisms.html").read_text()
    assert all(f">{file.stem}</code>" in shown for file in modules)
    assert Path(site / "search" / "search_index.js").exists()
