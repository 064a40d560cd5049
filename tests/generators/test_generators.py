"""What comes out of a generator: planted motion and noise, believable rows, the same for the same seed."""

import dataclasses

import numpy as np
import pytest
import torch
import yaml
from plant import CONF, NOISE, brief_config, config, motion, planted, preparation, share, swimming

from swarmtwin.errors import UserError
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import config_class, generator_config, generator_names
from swarmtwin.generators.sampling import draw_believable, synthetic_transitions
from swarmtwin.generators.training import fit
from swarmtwin.robot import Arena


def binned_mean_error(rows):
    """How far the mean displacement of rows in cells of commands is from the planted one: mean distances mm, rad."""
    cell = np.floor((rows[:, :2] + 120) / 48).astype(int).clip(0, 4) @ [5, 1]
    residual = rows[:, -3:] - motion(rows[:, :2])
    means = np.array([residual[cell == index].mean(axis=0) for index in range(25)])
    return np.abs(means).mean(axis=0)


def test_residual_diffusion_recovers_planted_motion_and_noise(trained):
    rows = draw_believable(trained["residual_diffusion"], 8000, seed=3).rows
    assert np.all(binned_mean_error(rows) < [0.6, 0.3, 0.015])
    residual = rows[:, -3:] - motion(rows[:, :2])
    np.testing.assert_allclose(residual.std(axis=0), NOISE, rtol=0.12)


def test_an_untrained_generator_recovers_nothing(real):
    untrained, _ = fit(real, config("residual_diffusion", mean_model_steps=1, noise_steps=1), seed=1)
    rows = draw_believable(untrained, 4000, seed=3).rows
    assert np.all(binned_mean_error(rows)[[0, 2]] > [3, 0.1])


def test_commands_come_back_as_they_were_driven(real, trained):
    command = draw_believable(trained["residual_diffusion"], 6000, seed=3).rows[:, :2]
    np.testing.assert_array_equal(command, command.round(1))
    assert (command.min(), command.max()) == (real.command.min(), real.command.max())
    for probability in (0.1, 0.25, 0.5, 0.75, 0.9):
        np.testing.assert_allclose(
            np.quantile(command, probability, axis=0), np.quantile(real.command, probability, axis=0), atol=8
        )
    assert abs(np.corrcoef(command.T)[0, 1]) < 0.06


def test_the_walls_are_learned_from_poses(robots):
    generator, history = fit(
        swimming(robots["mur"]), config("residual_diffusion", mean_model_steps=500, noise_steps=150), seed=1
    )
    row = generator.columns.split(draw_believable(generator, 6000, seed=3).rows)
    kept, fast = row.displacement[:, 0] / np.maximum(row.command[:, 1], 1), row.command[:, 1] > 20
    towards = (row.pose[:, 0] > 1800) & (np.cos(row.pose[:, 2]) > 0.5) & fast
    away = (row.pose[:, 0] > 1800) & (np.cos(row.pose[:, 2]) < -0.5) & fast
    far = (row.pose[:, 0] < 1400) & fast
    for place, expected in ((towards, 0.78), (away, 1.2), (far, 1.0)):
        assert share(row.pose[place]).mean() == pytest.approx(expected, abs=0.03)
    assert kept[far].mean() == pytest.approx(1, abs=0.03)
    assert kept[towards].mean() < 0.93 < 1.05 < kept[away].mean()
    assert history[-1]["validation_position_mm"] < history[0]["validation_position_mm"]


@pytest.mark.parametrize("name", generator_names())
def test_the_same_seed_gives_the_same_rows_and_leaves_the_global_random_numbers_alone(robots, name):
    few = planted(robots["mgr"], 600)
    quick = brief_config(name)
    before = torch.random.get_rng_state()
    first, second = (fit(few, quick, seed=5)[0] for _ in range(2))
    other = fit(few, quick, seed=6)[0]
    assert torch.equal(torch.random.get_rng_state(), before)
    for key, weights in first.state_dict().items():
        assert torch.equal(weights, second.state_dict()[key]), key
    assert any(not torch.equal(weights, other.state_dict()[key]) for key, weights in first.state_dict().items())
    drawn = [draw_believable(first, 300, seed).rows for seed in (1, 1, 2)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])


@pytest.mark.parametrize("name", generator_names())
def test_every_row_is_believable_and_keeps_its_columns(trained, robots, name):
    columns = Columns.of(robots["mgr"])
    drawn = draw_believable(trained[name], 500, seed=1)
    assert drawn.rows.shape == (500, 5)
    assert columns.believable(drawn.rows).all()
    assert next(iter(columns.units.items())) == ("left", "PWM")


def test_what_no_robot_can_do_is_drawn_again(trained, robots):
    tight = robots["mgr"].model_copy(deep=True)
    limit = tight.largest_displacement.model_copy(update={"forward_mm": 10.0})
    columns = Columns.of(tight.model_copy(update={"largest_displacement": limit}))
    generator = trained["residual_diffusion"]
    kept, generator.columns = generator.columns, columns
    try:
        drawn = draw_believable(generator, 1000, seed=1)
    finally:
        generator.columns = kept
    assert np.abs(drawn.rows[:, 2]).max() <= 10
    assert drawn.redrawn > 300
    assert 0.2 < drawn.redrawn_share < 0.8


def test_a_generator_of_nonsense_is_refused(trained, robots, monkeypatch):
    generator = trained["gan"]
    monkeypatch.setattr(generator, "sample", lambda count, rng: torch.full((count, 5), 1000.0))
    with pytest.raises(UserError, match=r"^generator 'gan': 256 of 256 transitions drawn are beyond what robot 'mgr'"):
        draw_believable(generator, 100, seed=1)


def test_only_the_training_split_is_learned(real, trained):
    planted_elsewhere = real.displacement.copy()
    planted_elsewhere[real.split == 2] = 1e6
    changed = dataclasses.replace(real, displacement=planted_elsewhere)
    generator, _ = fit(changed, config("residual_diffusion", mean_model_steps=5, noise_steps=5), seed=1)
    other, _ = fit(real, config("residual_diffusion", mean_model_steps=5, noise_steps=5), seed=1)
    for key, weights in generator.state_dict().items():
        assert torch.equal(weights, other.state_dict()[key]), key


def test_no_real_row_is_among_the_weights(real, trained):
    rows = {row.tobytes() for row in real.displacement.astype(np.float32)}
    for weights in trained["residual_diffusion"].state_dict().values():
        if weights.ndim == 2 and weights.shape[-1] == 3:
            assert not rows & {row.tobytes() for row in weights.float().numpy()}
    assert sum(weights.numel() for weights in trained["residual_diffusion"].state_dict().values()) < 60_000


def test_the_recording_s_own_arena_holds_and_not_the_robot_s_usual_one(robots, tmp_path):
    """The same drive in a pool elsewhere gives the same generator, whose poses lie there."""
    mur = robots["mur"]
    here, quick = swimming(mur, 1500), config("residual_diffusion", mean_model_steps=60, noise_steps=60)
    elsewhere = Arena(x=(7000, 9000), y=(-500, 500))
    moved = dataclasses.replace(here, pose=here.pose + np.array([7000, -500, 0]), arena_mm=elsewhere)
    drawn, drawn_there = (draw_believable(fit(each, quick, seed=1)[0], 400, seed=1).rows for each in (here, moved))
    assert not Columns.of(mur).believable(drawn_there).any()
    np.testing.assert_allclose(drawn_there[:, :2], drawn[:, :2], atol=0.2)
    assert np.quantile(np.abs(drawn_there[:, 3:5] - drawn[:, 3:5] - [7000, -500]), 0.95) < 5
    assert np.quantile(np.abs(drawn_there[:, -3:] - drawn[:, -3:]), 0.95) < 1
    transitions = synthetic_transitions(Columns.of(mur, elsewhere), drawn_there, validation=20)
    assert transitions.arena_mm == elsewhere


def test_too_little_data_is_refused(robots):
    with pytest.raises(UserError) as refused:
        fit(planted(robots["mgr"], 150), config("residual_diffusion"), seed=1)
    assert str(refused.value) == (
        "150 real transitions for training and 0 for validation are too few for a generator: "
        "it needs at least 200 and 2; record more runs"
    )


def test_values_that_are_not_finite_are_refused(real):
    broken = real.command.copy()
    broken[3, 1] = np.nan
    with pytest.raises(UserError, match=r"^right is not finite in 1 of 3600 transitions: prepare the recording anew$"):
        fit(dataclasses.replace(real, command=broken), config("residual_diffusion"), seed=1)


@pytest.mark.parametrize("part", ["previous_command", "velocity"])
def test_a_robot_whose_motion_depends_on_more_is_refused(robots, part):
    robot = robots["mgr"].model_copy(update={"situation": ("command", part)})
    with pytest.raises(UserError, match=rf"^robot 'mgr': its situation has {part}, and generators produce"):
        Columns.of(robot)


def test_synthetic_transitions_hold_what_was_generated_and_nothing_else(trained, robots, lineage):
    drawn = draw_believable(trained["residual_diffusion"], 450, seed=1)
    transitions, about = lineage.synthetic(Columns.of(robots["mgr"]), drawn, "residual_diffusion", "d1", seed=1)
    assert len(transitions.part("train")) + len(transitions.part("validation")) == 450
    assert len(transitions.part("validation")) == round(450 * 400 / 3600)
    assert len(transitions.part("test")) == 0
    assert transitions.runs[0] == "synthetic-00001"
    assert transitions.vehicles == ("synthetic",)
    for name in ("previous_command", "earlier_command", "pose", "velocity", "time_s"):
        assert np.isnan(getattr(transitions, name)).all(), name
    for run in range(len(transitions.runs)):
        assert len(set(transitions.split[transitions.run == run])) == 1
    assert (about.origin, about.generator.digest, about.learned) == ("synthetic", "d1", ("aa", "bb"))


def test_poses_are_generated_where_motion_depends_on_them(robots):
    rows = np.tile([10.0, 20, 5, 500, 500, 1, 10, 0, 0.1], (10, 1))
    transitions = synthetic_transitions(Columns.of(robots["mur"]), rows, validation=2)
    np.testing.assert_array_equal(transitions.pose, rows[:, 3:6])
    np.testing.assert_array_equal(transitions.displacement, rows[:, 6:])


def test_the_registry_holds_every_file_and_every_configuration_is_shipped():
    shipped = {path.stem for path in (CONF / "generator").glob("*.yaml")}
    assert set(generator_names()) == shipped
    for name in shipped:
        content = yaml.safe_load((CONF / "generator" / f"{name}.yaml").read_text())
        assert set(content) == set(config_class(name).model_fields)
        assert generator_config(content, name) == config_class(name)()


def test_an_unknown_generator_or_option_is_refused():
    with pytest.raises(
        UserError, match=r"^no such generator: 'residual_difusion': did you mean 'residual_diffusion'\? known: "
    ):
        generator_config({"name": "residual_difusion"}, "generator")
    with pytest.raises(UserError, match=r"^generator: unknown field 'member': did you mean 'members'\?"):
        generator_config({"name": "residual_diffusion", "member": 3}, "generator")


def test_synthetic_without_a_generator_is_no_preparation(real):
    with pytest.raises(ValueError, match="origin 'synthetic' and generator do not fit"):
        preparation(real, origin="synthetic")
