"""A campaign of faults against running deployments: a real mosquitto, emulated robots, an emulated camera, and chance.

`python tests/campaigns/faults.py --count 1000 --seed 1 --state outputs/faults.jsonl` goes on where it was broken off;
`--minutes 30` breaks it off by itself, `--table` shows what is in the state file. A drive is `swarmtwin deploy` in a
process forked from this one, which has imported everything. Faults that it may survive are brought into it one after
the other, each after the drive was seen to go on, and then one that it must answer. A witness with its own connection
and the true poses at hand says what became of each: no command beyond the limits, no vehicle that is still told to
move, or moves, a period after a fault which the host can answer, none beyond the fence by more than one period's
motion, no command that was sent and is not in the recording, no traceback, and a status that fits.
"""

import argparse
import importlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from fault_judgement import Brought, Seen, complaints, judged, lost_rows
from fault_kinds import KINDS, SURVIVABLE, TO_BE_ANSWERED
from fault_scene import REPOSITORY, Scene, Witness
from fault_table import Drive, as_line, read_drives, table
from forked import fork, in_a_child
from real_broker import wait_until

from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.deploy.tracking.calibration_fit import fit_calibration
from swarmtwin.deploy.tracking.calibration_pictures import take_pictures
from swarmtwin.policies.policy_folder import load_policy, save_policy

BUNDLED = REPOSITORY / "src" / "swarmtwin" / "deploy" / "bundled"


class Campaign:
    """Drives with faults, one after the other, in the same two scenes.

    Attributes:
        survivable: how many faults that may be survived are brought into a drive before the last one.
    """

    def __init__(self, place: Path, seed: int, survivable: int = 11) -> None:
        self.place, self.seed, self.survivable = place, seed, survivable
        self._scenes: dict[str, Scene] = {}
        self.project = place / "project"
        self.project.mkdir()
        self._small_disk = self._mount()
        os.environ["MLFLOW_TRACKING_URI"] = f"sqlite:///{place / 'mlflow.db'}"  # a new one takes seconds
        for module in ("deploy", "fleet"):
            importlib.import_module(f"swarmtwin.commands.{module}")
        in_a_child(self._keep_vehicles_busy)

    def _keep_vehicles_busy(self, targets: int = 12, steps: int = 600) -> None:
        """Store the bundled policy for a longer task: one target after the other, so that vehicles never rest."""
        stored = load_policy(BUNDLED / "policy")
        longer = {"targets": targets, "targets_apart_mm": 250.0, "hold_s": 0.5, "steps": steps}
        (self.place / "policy").mkdir()
        task = stored.task.model_copy(update=longer)
        save_policy(self.place / "policy", stored.policy, task, stored.arena, stored.provenance)

    def _mount(self) -> bool:
        """Give the project a small disk of its own, where this is allowed: what fills it harms nobody."""
        command = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(self.project)]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    def close(self) -> None:
        """Let all go."""
        for scene in self._scenes.values():
            scene.close()
        if self._small_disk:
            subprocess.run(["umount", str(self.project)], check=False)

    def scene(self, firmware: str) -> Scene:
        """Return the scene with the published firmware, or that with a time-out; its camera is calibrated."""
        if firmware not in self._scenes:
            place = self.place / firmware
            place.mkdir()
            scene = Scene(place, self.project, 0.5 if firmware == "time-out" else None, self.seed)
            self._scenes[firmware] = scene
            in_a_child(lambda: calibrate(scene, place / "calibration.yaml"))
        return self._scenes[firmware]

    def run_drive(self, number: int) -> Drive:
        """Drive once, with the faults that this number's chances choose."""
        began_s = time.monotonic()
        rng = random.Random(f"{self.seed} {number}")
        scene = self.scene(rng.choice(("published", "time-out")))
        scene.repair()
        for left in self.project.iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        scene.fleet.place(scene.fleet.draw_start(rng.randrange(2**31)))
        scene.controller = fork(self._arguments(scene, rng.randrange(2**31)), self.project, self.place)
        witness = Witness(scene)
        try:
            brought, status = self._disturb(number, scene, witness, rng)
        finally:
            scene.broker.thaw()
            witness.close()
        seen = Seen.by(witness)
        faults = [judged(one, seen, scene, status) for one in brought]
        is_answered = bool(brought) and KINDS[brought[-1].name].must_be_answered
        wrong, said = complaints(self.place, status, is_answered)
        wrong += seen.beyond_limits(scene.robot, 0.0, np.inf) + lost_rows(scene, seen)
        return Drive(
            number=number,
            firmware=scene.firmware,
            faults=faults,
            beyond_mm=round(max((one.beyond_mm for one in faults), default=-np.inf), 1),
            nearest_mm=round(seen.nearest_mm, 1),
            status=-99 if status is None else status,
            said=said,
            took_s=round(time.monotonic() - began_s, 1),
            wrong=wrong,
        )

    def _arguments(self, scene: Scene, seed: int) -> list[str]:
        calibration = self.place / scene.firmware / "calibration.yaml"
        return [
            *("deploy", "robot=mgr", f"policy={self.place / 'policy'}", f"simulation={BUNDLED / 'simulation'}"),
            *(f"broker={scene.broker.address}", f"camera={scene.fleet.camera_url}", f"calibration={calibration}"),
            *("page.port=0", "compare=0", f"seed={seed}", "output=out"),
        ]

    def _disturb(
        self, number: int, scene: Scene, witness: Witness, rng: random.Random
    ) -> tuple[list[Brought], int | None]:
        """Bring faults in until the drive has ended; return them, and the command's status."""
        process = _Process(scene.controller)
        names = self._drawn_faults(number, rng)
        wait_until(lambda: process.has_ended() or witness.moves(), 40)
        brought: list[Brought] = []
        for name in names:
            wait_until(process.has_ended, rng.uniform(0.0, 0.3))
            if process.has_ended() or not wait_until(lambda: process.has_ended() or witness.moves(), 3):
                break
            brought.append(self._bring(name, scene, witness, process, rng))
            if not brought[-1].went_on:
                break
        status = process.ended(25)
        if status == -signal.SIGKILL:  # the supervisor finishes the recording
            wait_until(lambda: (self.project / "out").exists(), 15)
        return brought, status

    def _drawn_faults(self, number: int, rng: random.Random) -> list[str]:
        """Draw some kinds that may be survived, each once, and end with one that must be answered.

        Of the latter each comes once in as many drives as there are kinds, in an order of chance.
        """
        turn, place = divmod(number, len(TO_BE_ANSWERED))
        last = random.Random(f"{self.seed} turn {turn}").sample(list(TO_BE_ANSWERED), len(TO_BE_ANSWERED))[place]
        without = {*TO_BE_ANSWERED[last].not_after, *(() if self._small_disk else ("disk full",))}
        kinds = [name for name in SURVIVABLE if name not in without]
        return [*rng.sample(kinds, min(self.survivable, len(kinds))), last]

    def _bring(self, name: str, scene: Scene, witness: Witness, process: "_Process", rng: random.Random) -> Brought:
        """Bring one fault in, take it away, and wait until the drive goes on or has ended."""
        kind = KINDS[name]
        began_s = time.monotonic()
        take_away = kind.bring(scene, rng)
        wait_until(lambda: process.has_ended() and not kind.must_be_answered, rng.uniform(*kind.lasts_s))
        take_away()
        away_s = time.monotonic()
        wait_until(lambda: process.has_ended() or witness.orders_after(away_s + 0.05), 4)
        went_on = not process.has_ended() and witness.orders_after(away_s + 0.05)
        if not went_on:
            process.ended(25)
        return Brought(name, began_s, away_s, time.monotonic(), went_on)


def calibrate(scene: Scene, file: Path) -> None:
    """Find out where a scene's camera hangs, once for all drives."""
    camera = open_camera(scene.fleet.camera_url)
    fit_calibration(take_pictures(camera), scene.robot).save(file)
    camera.close()


class _Process:
    """The process that drives, and how it ended."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._status: int | None = None

    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        if self._status is None:
            found, how = os.waitpid(self._number, os.WNOHANG)
            if found:
                self._status = os.waitstatus_to_exitcode(how)
        return self._status is not None

    def ended(self, longest_s: float) -> int | None:
        """Wait for its end, and return its status; None: it had to be killed."""
        if self._status is None and not wait_until(self.has_ended, longest_s):
            os.killpg(self._number, signal.SIGKILL)
            os.waitpid(self._number, 0)
            self._status = -99
        return None if self._status == -99 else self._status


def campaign(options: Any) -> list[Drive]:
    """Drive until there are as many faults as wanted, or the time is over; return all drives of the state file."""
    drives = read_drives(options.state)
    options.state.parent.mkdir(parents=True, exist_ok=True)
    os.environ["OMP_NUM_THREADS"] = "1"
    until_s = time.monotonic() + 60 * options.minutes
    place = Path(tempfile.mkdtemp())  # not a TemporaryDirectory: each forked process would remove it at its end
    made = Campaign(place, options.seed)
    try:
        with options.state.open("a") as state:
            while sum(len(drive.faults) for drive in drives) < options.count and time.monotonic() < until_s:
                drives.append(made.run_drive(len(drives)))
                state.write(as_line(drives[-1]))
                state.flush()
                _say(drives[-1])
    finally:
        made.close()
        shutil.rmtree(place, ignore_errors=True)
    return drives


def _say(drive: Drive) -> None:
    last = drive.faults[-1].name if drive.faults else "no fault"
    how = "; ".join(drive.failures)[:200] or "held"
    print(
        f"{drive.number:4d} {len(drive.faults):3d} {drive.took_s:6.1f} s {last:28s} {drive.status:4d} {how}", flush=True
    )


def main() -> None:
    """Run the campaign, or show its table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="faults in all")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="after which no further drive begins")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--state", type=Path, default=Path("outputs/faults.jsonl"))
    parser.add_argument("--table", action="store_true", help="only show the table")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that fleet, broker and disk are let go of
    if not options.table and shutil.which("mosquitto") is None:
        raise SystemExit("mosquitto is needed: apt install mosquitto")
    drives = read_drives(options.state) if options.table else campaign(options)
    if drives:
        print(table(drives))
    sys.exit(1 if any(drive.failures for drive in drives) else 0)


if __name__ == "__main__":
    main()
