"""How time and memory of a diagnosis grow with the session: `pytest -s -m benchmark_figures -k diagnosis_speed`."""

import pytest

from measured_command import COMMAND, called

HIDDEN = "effects=[{name: battery_sag, loss: 0.2}, {name: command_delay, delay_s: 0.05}]"
STEPS = 40

TIMED = (
    """
import time
import swarmtwin.commands.diagnose as module

def timed(*arguments, diagnose=module.diagnose):
    began = time.process_time()
    diagnosed = diagnose(*arguments)
    with open("diagnosing", "w") as file:
        file.write(str(time.process_time() - began))
    return diagnosed

module.diagnose = timed
"""
    + COMMAND
)


@pytest.mark.benchmark_figures
@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_sessions_of_6_000_to_100_000_transitions(tmp_path, robot):
    """Times are shown, on one core; the peak of 6,000 transitions is asserted, since it is the promise."""
    called(tmp_path, "record", f"robot={robot}", "vehicle=1", "runs=150", f"steps={STEPS}", "seed=1", "output=clean")
    train = ("model=crnet", "recording=clean", "seeds=1", "register=false", "pictures=false", "output=crnet")
    called(tmp_path, "train", f"robot={robot}", *train)
    per_transition = {}
    for transitions in (6_000, 30_000, 100_000):
        measured = f"measured_{transitions}"
        runs = f"runs={transitions // STEPS}"
        called(
            tmp_path,
            "record",
            f"robot={robot}",
            "vehicle=1",
            runs,
            f"steps={STEPS}",
            "seed=2",
            HIDDEN,
            f"output={measured}",
        )
        for simulation in ("reference=clean", "simulation=crnet"):
            output = f"output={simulation.partition('=')[0]}_{transitions}"
            options = (f"robot={robot}", simulation, f"measured={measured}", "register=false", "pictures=false", output)
            cpu_s, _, peak_mib = called(tmp_path, "diagnose", *options, command=TIMED)
            own_s = float((tmp_path / "diagnosing").read_text())
            per_transition.setdefault(simulation, own_s / transitions)
            print(
                f"\n{robot}, {transitions:,} transitions by {simulation}: diagnosis {own_s:.1f} s of CPU, a transition "
                f"{own_s / transitions / per_transition[simulation]:.2f} times as long as of 6,000; the command "
                f"{cpu_s:.0f} s; peak memory {peak_mib:,.0f} MiB",
                end="",
            )
            if transitions == 6_000:
                assert peak_mib < 2e9 / 2**20
    print()
