"""The folder to give away: read back bit for bit, understood by a stranger, refused when damaged."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from plant import CONF
from safetensors.torch import load_file, save_file

from swarmtwin.errors import UserError
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import generator_names
from swarmtwin.generators.generator_folder import load_generator, save_generator
from swarmtwin.generators.quality import Sets, assess
from swarmtwin.generators.sampling import draw_believable


@pytest.fixture(scope="module")
def quality(real, trained):
    columns = Columns.of(real.robot)
    rows = [columns.rows(real.part(split)) for split in ("train", "test")]
    return assess(columns, Sets(draw_believable(trained["gan"], 400, 1).rows, *rows), "test", 0.01, seed=1)


@pytest.fixture
def save(trained, lineage, quality, tmp_path):
    """Save a trained generator by its name; return its folder."""

    def saving(name):
        (tmp_path / name).mkdir()
        save_generator(tmp_path / name, trained[name], lineage, quality)
        return tmp_path / name

    return saving


@pytest.fixture
def saved(save):
    """The folders of two generators by name."""
    return {name: save(name) for name in ("residual_diffusion", "gan")}


def change(folder, **changes):
    path = folder / "generator.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}, sort_keys=False))


def refusal(folder):
    with pytest.raises(UserError) as refused:
        load_generator(folder)
    return str(refused.value)


@pytest.mark.parametrize("name", generator_names())
def test_a_generator_saved_and_loaded_draws_the_same_bit_for_bit(save, trained, lineage, quality, name):
    folder = save(name)
    before = torch.random.get_rng_state()
    generator, description = load_generator(folder)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert (description.lineage, description.quality) == (lineage, quality)
    rows = [draw_believable(each, 300, seed=9).rows for each in (generator, trained[name])]
    np.testing.assert_array_equal(*rows)


def test_the_folder_holds_three_files_and_no_real_row(saved):
    assert sorted(path.name for path in saved["residual_diffusion"].iterdir()) == [
        "README.md",
        "generator.yaml",
        "weights.safetensors",
    ]
    assert sum(path.stat().st_size for path in saved["residual_diffusion"].iterdir()) < 400_000


def test_the_card_says_what_a_stranger_asks(saved, quality):
    card = (saved["gan"] / "README.md").read_text()
    for answer in (
        "Micro-Ground Robot (mgr)",
        "swarmtwin generate from=",
        "| `left` | PWM | command, -120 to 120 |",
        "| `turn_rad` | rad | how far it turns, counter-clockwise positive |",
        "Recording `monday`",
        "3200 transitions to learn from and 400 to follow the training by",
        f"| exact copies of what it learned from | {quality.exact_copies} | | 0 |",
        "## Limits",
    ):
        assert answer in card


def test_the_folder_keeps_the_arena(saved, trained):
    _, description = load_generator(saved["residual_diffusion"])
    assert description.arena_mm == trained["residual_diffusion"].columns.arena_mm


def test_what_is_missing_is_named(saved, tmp_path):
    folder = saved["gan"]
    (folder / "weights.safetensors").unlink()
    assert refusal(folder) == f"{folder}/weights.safetensors is missing: generate the folder anew"
    assert refusal(tmp_path) == (
        f"no generator in {tmp_path}: generator.yaml is missing; name a folder that generate made"
    )


def test_damage_is_named(saved):
    folder = saved["gan"]
    weights = folder / "weights.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(whole[:-100])
    assert refusal(folder).startswith(f"{weights} is damaged (")
    broken = load_file(saved["residual_diffusion"] / "weights.safetensors")
    broken["mean_model.offset"][0] = torch.nan
    save_file(broken, saved["residual_diffusion"] / "weights.safetensors")
    assert refusal(saved["residual_diffusion"]).endswith("mean_model.offset is not finite; generate the folder anew")
    weights.write_bytes(whole)
    (folder / "generator.yaml").write_text("generator: [")
    assert refusal(folder).startswith(f"{folder}/generator.yaml is damaged: ")


def test_weights_of_another_generator_do_not_belong(saved):
    (saved["gan"] / "weights.safetensors").write_bytes(
        (saved["residual_diffusion"] / "weights.safetensors").read_bytes()
    )
    assert refusal(saved["gan"]) == (
        f"{saved['gan']}/weights.safetensors does not belong to generator.yaml beside it: generate the folder anew"
    )


def test_a_description_that_does_not_fit_is_refused(saved):
    folder = saved["gan"]
    original = yaml.safe_load((folder / "generator.yaml").read_text())
    change(folder, columns={"left": "PWM"})
    assert ": columns: left are not those of its robot: left, right, forward_mm" in refusal(folder)
    change(folder, **original | {"format": 2})
    assert refusal(folder).endswith("format 2 is not known here: update swarmtwin, or generate anew")
    change(folder, **original | {"generator": {"name": "gann"}})
    assert refusal(folder).startswith("no such generator: 'gann': did you mean 'gan'?")
    mur = yaml.safe_load((CONF / "robot" / "mur.yaml").read_text())
    change(folder, **original | {"robot": mur})
    assert "are not those of its robot: mean_angle_deg" in refusal(folder)
    change(folder, **original | {"lineage": {**original["lineage"], "seeed": 1}})
    assert "unknown field 'lineage.seeed'" in refusal(folder)


def test_nothing_in_the_description_is_executed(saved, tmp_path):
    (saved["gan"] / "generator.yaml").write_text(f"!!python/object/apply:os.mkdir ['{tmp_path}/executed']")
    assert "is damaged" in refusal(saved["gan"])
    assert not (tmp_path / "executed").exists()


def test_the_quality_is_plain_data(quality):
    assert json.loads(quality.model_dump_json())["exact_copies"] == quality.exact_copies
    assert {"precision", "recall", "told_apart", "noise_turn_rad"} <= set(quality.tracked())


def test_a_folder_that_an_earlier_version_saved_as_diffusion_draws_the_same(tmp_path):
    """Saved by the version before the renaming, with the first of the 300 rows that it drew with seed 1."""
    saved = Path(__file__).parent / "old_diffusion"
    generator, description = load_generator(saved)
    assert (description.generator["name"], generator.config.name) == ("diffusion", "residual_diffusion")
    drawn = draw_believable(generator, 300, seed=1).rows[:20]
    np.testing.assert_allclose(drawn, np.loadtxt(saved / "drawn.csv", delimiter=","), rtol=2e-4, atol=2e-4)
