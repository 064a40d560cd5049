"""Whatever lies in `conf/` is of use: every file composes to typed options, and what learns takes a step with it."""

import importlib

import hydra
import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.training import train
from swarmtwin.generators.generator import generator_config
from swarmtwin.generators.training import fit
from toy import CONF, recipe, toy_transitions


def files(group):
    return sorted((CONF / group).glob("*.yaml"))


def words(group):
    return [file.stem for file in files(group)]


def content(group, word):
    return yaml.safe_load((CONF / group / f"{word}.yaml").read_text())


def mean(command):
    return np.column_stack([command[:, 0] * 0.1, command[:, 1] * 0.01, command[:, -1] * 0.002])


def data_of(robot, count=320):
    return toy_transitions(robot, count, noise=(1.0, 1.0, 0.03), mean=mean, steps=32)


@pytest.mark.parametrize("robot", words("robot"))
@pytest.mark.parametrize("word", words("model"))
def test_every_model_learns_a_batch_of_every_robot(robots, word, robot):
    config = model_config(content("model", word), word)
    data = data_of(robots[robot])
    trained = train(data, config, recipe(epochs=1, batch_size=192), [0])
    assert np.isfinite(predict(trained.dynamics, data)).all()


@pytest.mark.parametrize("word", words("recipe"))
def test_every_recipe_trains_an_epoch(robots, word):
    chosen = recipe(word)
    assert chosen.name == word
    few = chosen.model_copy(update={"epochs": 1})
    assert len(train(data_of(robots["mgr"]), model_config({"name": "mlp"}, "model"), few, [0]).best.history) == 1


@pytest.mark.parametrize("robot", ["mgr", "mur", "create"])
@pytest.mark.parametrize("word", words("generator"))
def test_every_generator_takes_a_step_for_every_robot_without_momentum(robots, word, robot):
    shipped = content("generator", word)
    few = {name: 1 for name in shipped if name.split("_")[-1] == "steps"} | {"sampling_steps": 2}
    config = generator_config({**shipped, **{name: few[name] for name in few if name in shipped}}, word)
    generator, history = fit(data_of(robots[robot], 640), config, seed=0)
    assert history
    assert all(weights.isfinite().all() for weights in generator.state_dict().values())


COMPOSED = {**{name: entry.module for name, entry in COMMANDS.items() if name != "experiment"}}
STUDIES = words("experiment")


def options_class(config_name):
    """The typed options of a command, or of a study."""
    if config_name in COMPOSED:
        return importlib.import_module(f"swarmtwin.commands.{COMPOSED[config_name]}").Options
    return importlib.import_module(f"swarmtwin.studies.{config_name.partition('/')[2]}.study").Options


def groups_of(config_name):
    """The folders of `conf/` from which a configuration takes a file, and may take another."""
    defaults = yaml.safe_load((CONF / f"{config_name}.yaml").read_text()).get("defaults", [])
    named = [next(iter(entry)) for entry in defaults if isinstance(entry, dict)]
    return [group.lstrip("/") for group in named if not group.startswith("override") and "@" not in group]


def choices():
    for config_name in [*COMPOSED, *(f"experiment/{study}" for study in STUDIES)]:
        for group in ("", *groups_of(config_name)):
            for word in words(group) if group else [""]:
                yield config_name, f"{group}={word}" if group else ""


@pytest.mark.parametrize("config_name", [*COMPOSED, *(f"experiment/{study}" for study in STUDIES)])
def test_every_choice_of_a_file_composes_to_typed_options(config_name):
    options = options_class(config_name)
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        for chosen in [choice for name, choice in choices() if name == config_name]:
            composed = OmegaConf.to_container(hydra.compose(config_name, [chosen] if chosen else []), resolve=True)
            composed = {name: "given" if value == "???" else value for name, value in composed.items()}
            assert options.parse(composed, f"{config_name} {chosen}")
