"""Options as they are mistyped: one sentence of ours, with the remedy, and never a word of Hydra's grammar."""

import pytest

from swarmtwin.commands.app import run_command


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("output=a=b", "option 'output': 'a=b' holds what is no plain text to Hydra: put quotation marks around it"),
        (
            "output=out é",
            "option 'output': 'out é' holds what is no plain text to Hydra: put quotation marks",
        ),
        ('output=a="b"', '\'output="a=\\"b\\""\''),
        ("robot mgr", "'robot mgr' is no option with its value: write robot=mgr"),
        ("robot", "'robot' is no option with its value: write robot=..."),
        ("", "'' is no option with its value: write NAME=..."),
        (" output=o", "' output=o' begins with what is no option's name: write output=..."),
        ("split.fractions=[2,3]", "'split.fractions' is made of parts: set them one by one, split.fractions.train=..."),
        ("robot.arena_mm.x={low: 1}", "option 'robot.arena_mm.x' is a list: write robot.arena_mm.x=[...]"),
        ("robot=[{name: x", "option 'robot': '[{name: x' has a bracket without its partner"),
        ("output='a", "has a quotation mark without its partner"),
        ("robot=", "option 'robot' has no value: choose one of car, create, mgr, mur"),
        ("output=", "option 'output' has no value: write output=VALUE"),
        ("~output", "'~output' takes away what has no value yet: give it one, output=..."),
        ("+robot=mgr", "'robot' is chosen already: write robot=..., without +"),
        ("robot=mgr,mur", "'robot=mgr,mur' names several: add -m for one run each"),
        ("output=${nothing}", "option 'output' refers to another one that cannot be found"),
        ("--output=o", "unknown option '--output=o': write output=o, without dashes"),
        ("--config-dir", "argument --config-dir/-cd: expected one argument"),
    ],
)
def test_a_mistyped_option_is_one_sentence_with_the_remedy(workplace, capfd, argument, message):
    assert run_command("prepare", ["recording=nowhere", argument]) == 2
    error = capfd.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert "hydra.cc" not in error
    assert list(workplace.iterdir()) == []


def test_of_an_option_given_twice_the_last_value_holds_and_that_is_said(workplace, capfd, caplog):
    assert run_command("prepare", ["recording=here", "recording=nowhere", "output=a", "output=a"]) == 2
    assert caplog.messages == ["option 'recording' is given twice: recording=nowhere holds, not recording=here"]
    assert "no recording folder nowhere" in capfd.readouterr().err


def test_the_remedy_for_a_value_with_a_meaning_of_its_own_works(workplace, capfd):
    assert run_command("prepare", ["recording=nowhere", 'output="out é=1"']) == 2
    assert "no recording folder nowhere" in capfd.readouterr().err
