"""Whatever lies in `conf/` is of use: every file composes to typed options, and what learns takes a step with it."""

import importlib
import shlex

import hydra
import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.commands.experiment import study_module
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


COMPOSED = (
    *(name for name in COMMANDS if name != "experiment"),
    *(f"experiment/{study}" for study in words("experiment")),
)


def options_class(config_name):
    """The typed options of a command, or of a study."""
    room, _, study = config_name.partition("/")
    module = study_module(study) if study else f"swarmtwin.commands.{COMMANDS[room].module}"
    return importlib.import_module(module).Options


def named_groups_of(config_name):
    """The folders of `conf/` from which a configuration takes a file, with `@` where it takes it elsewhere."""
    defaults = yaml.safe_load((CONF / f"{config_name}.yaml").read_text()).get("defaults", [])
    named = [next(iter(entry)).lstrip("/") for entry in defaults if isinstance(entry, dict)]
    return [group for group in named if not group.startswith("override")]


def groups_of(config_name):
    """The folders of `conf/` from which a configuration takes a file, and may take another."""
    return [group for group in named_groups_of(config_name) if "@" not in group]


def compositions():
    """Every configuration as it is, and with every file of a folder in place of the usual one, each file once."""
    seen = set()
    for config_name in COMPOSED:
        own = [group for group in groups_of(config_name) if group not in seen]
        seen.update(own)
        yield config_name, ["", *(f"{group}={word}" for group in own for word in words(group))]


@pytest.mark.parametrize(("config_name", "chosen"), compositions())
def test_every_file_composes_to_typed_options(config_name, chosen):
    options = options_class(config_name)
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        for choice in chosen:
            composed = OmegaConf.to_container(hydra.compose(config_name, [choice] if choice else []), resolve=True)
            composed = {name: "given" if value == "???" else value for name, value in composed.items()}
            assert options.parse(composed, f"{config_name} {choice}")


def test_no_folder_is_forgotten():
    """What lies in a folder is chosen from by some command; studies by their name, launchers by Hydra."""
    used = {group.partition("@")[0] for config_name in COMPOSED for group in named_groups_of(config_name)}
    assert {folder.name for folder in CONF.iterdir() if folder.is_dir()} - {"experiment", "hydra"} <= used


PAGES = {"collective": "policy_seeds@collective_room", "obstacle": "policy_seeds@obstacle", "pair": "pair_critic_first"}


def test_every_preset_is_measured():
    assert sorted(PAGES) == words("preset")


@pytest.mark.parametrize("preset", PAGES)
def test_a_preset_is_what_ten_seeds_were_learned_with(preset):
    """What `dvc repro docs/results/dvc.yaml` runs, and what the word stands for, compose to the same."""
    lock = yaml.safe_load((CONF.parent / "docs/results/dvc.lock").read_text())
    _, *given = shlex.split(lock["stages"][PAGES[preset]]["cmd"].partition("experiment ")[2])
    at_hand = [one for one in given if one.partition("=")[0] in ("simulation", "seed", "output")]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        as_run, as_preset = (
            OmegaConf.to_container(hydra.compose("experiment/policy_seeds", options))
            for options in (given, [f"preset={preset}", *at_hand])
        )
    assert as_run == as_preset
