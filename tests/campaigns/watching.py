"""How soon the watching simulation names a vehicle, and how often a sound one: the bundled CR-Net-S and stand-ins.

`python tests/campaigns/watching.py` (a minute) drives units that it has never seen, by the bundled policy and by random
commands as in a recording, without a camera or a link, with nothing wrong and with gains that are wrong from the start.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from swarmtwin.deploy.control.expectation import Expectation
from swarmtwin.deploy.control.settings import WatchSettings
from swarmtwin.geometry import displacement_between
from swarmtwin.policies.policy_folder import load_policy
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.world.scenario import Scenario

BUNDLED = Path(__file__).resolve().parents[2] / "src" / "swarmtwin" / "deploy" / "bundled"
POLICY = load_policy(BUNDLED / "policy")
SIMULATION = load_simulation(BUNDLED / "simulation", POLICY.robot)[0].eval()
TASK = POLICY.task.model_copy(update={"targets": 12, "targets_apart_mm": 250.0, "hold_s": 0.5, "steps": 600}).build(
    POLICY.robot, POLICY.arena
)
Decide = Callable[[Scenario, np.ndarray], np.ndarray]


def by_policy(scenario: Scenario, pose: np.ndarray) -> np.ndarray:
    """Return the policy's commands (1, V, m)."""
    return POLICY.policy.act(TASK.observe(scenario, pose))


def at_random(seed: int) -> Decide:
    """Return what draws commands as `record` does."""
    rng = np.random.default_rng(seed)
    low, high = POLICY.robot.command_low, POLICY.robot.command_high
    return lambda scenario, pose: rng.uniform(low, high, (*pose.shape[:2], len(low)))


def driven(vehicles: tuple[str, ...], effects: list[dict[str, Any]], seed: int, decide: Decide, periods: int) -> Any:
    """Drive a group; return expected and measured displacements, (T, V, 3) each."""
    live = LiveVehicles(POLICY.robot, vehicles, 1, seed, parse_effects(effects, POLICY.robot, len(vehicles)))
    scenario = TASK.draw(np.random.default_rng(seed), 1)
    pose = live.place(np.array([0]), scenario.start)
    state = SIMULATION.start(torch.as_tensor(pose))
    expected, measured = [], []
    for _ in range(periods):
        command = np.asarray(decide(scenario, pose), float).round()
        if (TASK.target_distance_mm(scenario, pose) < TASK.config.reach_mm).all():
            scenario = scenario.advanced(np.array([True]))
        after_pose = live.move(command)
        with torch.inference_mode():
            state = replace(state, pose=torch.as_tensor(pose))
            after = SIMULATION.step(state, torch.as_tensor(command))
        expected.append(displacement_between(state.pose[0], after.pose[0]).numpy())
        measured.append(displacement_between(pose[0], after_pose[0]))
        state, pose = after, after_pose
    return np.array(expected), np.array(measured)


def first_alarms(effects: list[dict[str, Any]], drives: int, drawn: bool, periods: int) -> np.ndarray:
    """Return after how many periods each of five vehicles in each drive was named, inf where it was not."""
    first = []
    for number in range(drives):
        vehicles = tuple(str(2 + 5 * number + index) for index in range(5))
        decide = at_random(number) if drawn else by_policy
        watch = Expectation(SIMULATION, vehicles, WatchSettings())
        named = np.full(5, np.inf)
        expected, measured = driven(vehicles, effects, 100 + number, decide, periods)
        for period in range(periods):
            begun = watch.update(expected[period], measured[period], np.full(5, POLICY.robot.period_s))
            named[begun] = np.minimum(named[begun], period + 1)
        first.append(named)
    return np.concatenate(first)


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    print("| wrong from the start | driven by | vehicles, periods | named | within 10 | median |")
    print("| --- | --- | --- | --- | --- | --- |")
    for gain, drives, periods in ((1.0, 40, 100), (0.7, 16, 60), (0.5, 16, 60)):
        effects = [] if gain == 1.0 else [{"name": "gain_change", "gain": gain}]
        for drawn in (True, False):
            first = first_alarms(effects, drives, drawn, periods)
            what = "nothing" if gain == 1.0 else f"all speeds {gain - 1:+.0%}"
            shares = f"{np.isfinite(first).mean():.1%} | {(first <= 10).mean():.0%} | {np.median(first):.0f}"
            print(f"| {what} | {'chance' if drawn else 'policy'} | {len(first)}, {periods} | {shares} |", flush=True)


if __name__ == "__main__":
    main()
