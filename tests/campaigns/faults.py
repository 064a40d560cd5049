"""A campaign of faults against a running deployment: a real mosquitto, emulated robots, an emulated camera, and chance.

`python tests/campaigns/faults.py --count 1000 --seed 1 --state outputs/faults.jsonl` goes on where it was broken off;
`--table` shows what is in the state file. A drive is `swarmtwin deploy` in a process forked from this one, which has
imported everything. Into each drive some faults are brought that it may survive, and then one that it must answer. A
witness with its own connection and the true poses at hand says what happened: no command beyond the limits, no vehicle
that is still told to move, or moves, a period after a fault which the host can answer, none beyond the fence by more
than one period's motion, no command that was sent and is not in the recording, no traceback, and a status that fits.
"""

import argparse
import atexit
import collections
import contextlib
import importlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from paho.mqtt.client import Client, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests" / "deploy"))

from real_broker import Mosquitto, wait_until  # noqa: E402

from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings  # noqa: E402
from swarmtwin.deploy.fleet.orders import CameraFaults, RobotFaults  # noqa: E402
from swarmtwin.deploy.link.message_format import MessageFormat  # noqa: E402
from swarmtwin.robot import Robot  # noqa: E402

BUNDLED = REPOSITORY / "src" / "swarmtwin" / "deploy" / "bundled"


class Case(NamedTuple):
    """One drive: the faults that were brought into it, and how it ended.

    Attributes:
        number: of the drive.
        survived: faults that it may survive, in order.
        fault: the one that it must answer; "" where the drive had ended before.
        firmware: "time-out" or "published".
        answer_s: from that fault to the moment at which all vehicles are told to stand; None: there was no such fault.
        beyond_mm: how far a vehicle's centre was beyond the fence at most; negative: it stayed inside.
        nearest_mm: least distance of two centres.
        status: of the command.
        said: its last line.
        outcome: "held", or what went wrong.
    """

    number: int
    survived: list[str]
    fault: str
    firmware: str
    answer_s: float | None
    beyond_mm: float
    nearest_mm: float
    status: int
    said: str
    outcome: str


class Witness:
    """Sees all messages on the topic of commands, and every 0.01 s where vehicles are and what they are told."""

    def __init__(self, fleet: Fleet, port: int) -> None:
        self.fleet = fleet
        self.messages: list[tuple[float, bytes]] = []
        self.moments: list[float] = []
        self.poses: list[np.ndarray] = []
        self.told: list[np.ndarray] = []
        self._ends = threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2, "witness", protocol=MQTTv311)
        self._client.on_connect = lambda client, *_: client.subscribe(fleet.robot.link.command_topic)
        self._client.on_message = lambda _, __, message: self.messages.append(
            (time.monotonic(), bytes(message.payload))
        )
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._ends.wait(0.01):
            self.moments.append(time.monotonic())
            self.poses.append(np.array([*self.fleet.true_poses().values()]))
            self.told.append(np.array([*self.fleet.true_commands().values()]))

    def close(self) -> None:
        """Look no longer."""
        self._ends.set()
        self._thread.join()
        self._client.disconnect()
        self._client.loop_stop()


class Scene:
    """What a drive takes place in: broker, fleet, and the process that drives.

    Attributes:
        controller: process id of `swarmtwin deploy`.
        own: payloads that this campaign has sent itself.
    """

    def __init__(self, place: Path, firmware_timeout_s: float | None, seed: int) -> None:
        self.place = place
        self.robot = Robot.load(REPOSITORY / "conf" / "robot" / "mgr.yaml")
        self.broker = Mosquitto(place)
        vehicles = tuple(str(1 + index) for index in range(5))
        settings = FleetSettings(seed=seed, firmware_timeout_s=firmware_timeout_s)
        self.fleet = Fleet(self.robot, vehicles, self.broker.broker, 0, settings)
        self.message_format = MessageFormat(self.robot)
        self.firmware = "time-out" if firmware_timeout_s else "published"
        self.controller = 0
        self.own: list[bytes] = []
        self.filled: Path | None = None

    def child(self, module: str) -> int:
        """Return the process id of the controller's child that runs a module; 0: there is none."""
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError, IndexError):
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == self.controller and module in (entry / "cmdline").read_text():
                    return int(entry.name)
        return 0

    def repair(self) -> None:
        """Put everything right again that a fault has broken."""
        self.broker.thaw()
        if not self.broker._listens():
            self.broker.start()
        self.fleet.set_faults({}, CameraFaults())
        for process in (self.fleet.camera, *self.fleet.robots.values()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGCONT)
        if not self.fleet.camera.is_running:
            self.fleet.restart_camera()
        for vehicle, process in list(self.fleet.robots.items()):
            if not process.is_running:
                self.fleet.restart_robot(vehicle)
        self.own.clear()
        if self.filled:
            self.filled.unlink(missing_ok=True)
            self.filled = None

    def close(self) -> None:
        """Let all go."""
        self.repair()
        self.fleet.close()
        self.broker.stop()


Bring = Callable[[Scene, random.Random], Callable[[], None]]
"""Brings a fault into a scene; returns what takes it away."""


def _robots(scene: Scene, rng: random.Random, **fault: Any) -> Callable[[], None]:
    chosen = scene.fleet.vehicles if rng.random() < 0.5 else [rng.choice(scene.fleet.vehicles)]
    scene.fleet.set_faults(robots={vehicle: RobotFaults(**fault) for vehicle in chosen})
    return lambda: scene.fleet.set_faults(robots={})


def _camera(scene: Scene, **fault: Any) -> Callable[[], None]:
    scene.fleet.set_faults(camera=CameraFaults(**fault))
    return lambda: scene.fleet.set_faults(camera=CameraFaults())


def _signal(process: int, number: signal.Signals) -> Callable[[], None]:
    def wake() -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGCONT)

    if process:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)
    return wake


def _another_controller(scene: Scene, rng: random.Random) -> Callable[[], None]:
    command = np.array([rng.uniform(30, 120), rng.uniform(-120, -30)]).round()
    messages = scene.message_format.messages({rng.choice(scene.fleet.vehicles): command})
    for topic, payload in messages.items():
        scene.own.append(payload if isinstance(payload, bytes) else payload.encode())
        client = Client(CallbackAPIVersion.VERSION2, "stranger", protocol=MQTTv311)
        client.connect("127.0.0.1", scene.broker.port)
        client.loop_start()
        client.publish(topic, scene.own[-1]).wait_for_publish(1)
        client.disconnect()
        client.loop_stop()
    return lambda: None


def _full_disk(scene: Scene, rng: random.Random) -> Callable[[], None]:
    scene.filled = scene.place / "project" / "filling"
    with scene.filled.open("wb") as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(1 << 16))
            file.flush()
    return lambda: None


def _broker_again(scene: Scene, rng: random.Random) -> Callable[[], None]:
    scene.broker.stop()
    time.sleep(rng.uniform(0, 0.1))
    scene.broker.start()
    return lambda: None


def _kill_camera(scene: Scene, rng: random.Random) -> Callable[[], None]:
    return _signal(scene.fleet.camera.pid, signal.SIGKILL)


SURVIVABLE: dict[str, Bring] = {
    "commands late": lambda scene, rng: _robots(scene, rng, latency_s=rng.uniform(0, 0.2)),
    "commands late by chance, overtaking": lambda scene, rng: _robots(scene, rng, jitter_s=rng.uniform(0.1, 0.7)),
    "commands lost": lambda scene, rng: _robots(scene, rng, loss=rng.uniform(0.05, 0.5)),
    "commands twice": lambda scene, rng: _robots(scene, rng, duplicate=0.5, jitter_s=0.1),
    "commands in another order": lambda scene, rng: _robots(scene, rng, reorder=0.3),
    "pictures lost": lambda scene, rng: _camera(scene, drop=rng.uniform(0.1, 0.6)),
    "pictures late": lambda scene, rng: _camera(scene, delay_s=rng.uniform(0.02, 0.12)),
    "camera's clock steps": lambda scene, rng: _camera(scene, clock_s=rng.choice((-1, 1)) * 10 ** rng.uniform(-1, 6)),
    "live view frozen": lambda scene, rng: _signal(scene.child("live_view"), signal.SIGSTOP),
    "live view killed": lambda scene, rng: _signal(scene.child("live_view"), signal.SIGKILL),
    "robot frozen for a while": lambda scene, rng: _signal(
        scene.fleet.robots[rng.choice(scene.fleet.vehicles)].pid, signal.SIGSTOP
    ),
    "disk full": _full_disk,
}
TO_BE_ANSWERED: dict[str, Bring] = {
    "camera silent": lambda scene, rng: _camera(scene, silent=True),
    "camera frozen": lambda scene, rng: _camera(scene, frozen=True),
    "camera killed": _kill_camera,
    "pictures much too late": lambda scene, rng: _camera(scene, delay_s=rng.uniform(0.6, 3)),
    "marker hidden": lambda scene, rng: _camera(scene, hidden=frozenset({rng.choice(scene.fleet.vehicles)})),
    "controller frozen": lambda scene, rng: _signal(scene.controller, signal.SIGSTOP),
    "controller killed": lambda scene, rng: _signal(scene.controller, signal.SIGKILL),
    "controller interrupted": lambda scene, rng: _signal(scene.controller, signal.SIGINT),
    "controller terminated": lambda scene, rng: _signal(scene.controller, signal.SIGTERM),
    "supervisor frozen": lambda scene, rng: _signal(scene.child("control.supervisor"), signal.SIGSTOP),
    "supervisor killed": lambda scene, rng: _signal(scene.child("control.supervisor"), signal.SIGKILL),
    "another controller": _another_controller,
    "broker restarted": _broker_again,
    "broker frozen": lambda scene, rng: (scene.broker.freeze(), scene.broker.thaw)[1],
    "broker killed": lambda scene, rng: (scene.broker.stop(), lambda: None)[1],
}
ONLY_BY_FIRMWARE = ("broker frozen", "broker killed")


class Campaign:
    """Drives with faults, one after the other, in the same two scenes."""

    def __init__(self, place: Path, seed: int) -> None:
        self.place, self.seed = place, seed
        self._scenes: dict[str, Scene] = {}
        self.project = place / "project"
        self.project.mkdir()
        self._small_disk = self._mount()
        for module in ("deploy", "fleet"):
            importlib.import_module(f"swarmtwin.commands.{module}")
        from swarmtwin import commands

        self._commands = commands

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
        """Return the scene with the published firmware, or that with a time-out."""
        if firmware not in self._scenes:
            place = self.place / firmware
            place.mkdir()
            self._scenes[firmware] = Scene(place, 0.5 if firmware == "time-out" else None, self.seed)
            self._scenes[firmware].place = self.place
        return self._scenes[firmware]

    def fork_deployment(self, scene: Scene, seed: int) -> int:
        """Start `swarmtwin deploy` in a process forked from this one, without other threads; return its id."""
        arguments = [
            *("deploy", "robot=mgr", f"policy={BUNDLED / 'policy'}", f"simulation={BUNDLED / 'simulation'}"),
            *(f"broker={scene.broker.address}", f"camera={scene.fleet.camera_url}", "page.port=0", "compare=0"),
            *(f"seed={seed}", "output=out"),
        ]
        process = os.fork()
        if process:
            return process
        status = 1
        try:
            os.setpgid(0, 0)
            os.chdir(self.project)
            for number, name in ((0, os.devnull), (1, "shown"), (2, "error")):
                flags = os.O_RDONLY if number == 0 else os.O_CREAT | os.O_WRONLY | os.O_TRUNC
                target = name if number == 0 else str(self.place / name)
                os.dup2(os.open(target, flags), number)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            sys.argv = ["swarmtwin", *arguments]
            self._commands.main()
            status = 0
        except SystemExit as ending:
            status = int(ending.code or 0)
        except BaseException:
            traceback.print_exc()
        finally:
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        raise AssertionError

    def run_case(self, number: int) -> Case:
        """Drive once, with the faults that this number's chances choose."""
        rng = random.Random(f"{self.seed} {number}")
        scene = self.scene(rng.choice(("published", "time-out")))
        scene.repair()
        for left in self.project.iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        starts = scene.fleet.draw_start(rng.randrange(2**31))
        scene.fleet.place(starts)
        faults = [name for name in SURVIVABLE if name != "disk full" or self._small_disk]
        chosen, last = rng.sample(faults, 3), rng.choice(list(TO_BE_ANSWERED))
        seed = rng.randrange(2**31)
        scene.controller = self.fork_deployment(scene, seed)
        witness = Witness(scene.fleet, scene.broker.port)
        try:
            survived, brought_s, status = self._drive(scene, witness, rng, chosen, last)
        finally:
            scene.broker.thaw()
            witness.close()
        return self._judge(number, scene, witness, survived, last, brought_s, status)

    def _drive(
        self, scene: Scene, witness: Witness, rng: random.Random, chosen: list[str], last: str
    ) -> tuple[list[str], float | None, int | None]:
        """Bring the faults in; return those survived, when the last one was, and the command's status."""
        status: list[int] = []

        def has_ended() -> bool:
            if not status:
                found, how = os.waitpid(scene.controller, os.WNOHANG)
                if found:
                    status.append(os.waitstatus_to_exitcode(how))
            return bool(status)

        wait_until(lambda: has_ended() or any(told.any() for told in witness.told[-3:]), 40)
        survived = []
        for name in chosen:
            if has_ended():
                break
            take_away = SURVIVABLE[name](scene, rng)
            survived.append(name)
            wait_until(has_ended, rng.uniform(0.3, 1.2))
            take_away()
            wait_until(has_ended, rng.uniform(0.1, 0.6))
        brought_s = None
        if not has_ended() and any(told.any() for told in witness.told[-60:]):
            brought_s = time.monotonic()
            take_away = TO_BE_ANSWERED[last](scene, rng)
            wait_until(lambda: False, rng.uniform(1.0, 2.5))
            take_away()
        wait_until(has_ended, 25)
        if not has_ended():
            os.killpg(scene.controller, signal.SIGKILL)
            os.waitpid(scene.controller, 0)
        if status == [-signal.SIGKILL]:  # the supervisor finishes the recording
            wait_until(lambda: (self.project / "out").exists(), 15)
        return survived, brought_s, status[0] if status else None

    def _judge(
        self,
        number: int,
        scene: Scene,
        witness: Witness,
        survived: list[str],
        last: str,
        brought_s: float | None,
        status: int | None,
    ) -> Case:
        error = (self.place / "error").read_text(errors="replace")
        shown = (self.place / "shown").read_text(errors="replace")
        moments, told, poses = np.array(witness.moments), np.array(witness.told), np.array(witness.poses)
        arena, robot = scene.robot.arena_mm, scene.robot
        position = poses[..., :2]
        beyond_mm = float(np.maximum(arena.low_mm - position, position - arena.high_mm).max())
        apart = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1) + 1e9 * np.eye(position.shape[1])
        wrong = []
        answer_s = None
        if brought_s is not None:
            told_to_move = (told != 0).any(axis=(1, 2))
            answer_s = _until_rest(moments, told_to_move, brought_s) - brought_s
            by_firmware = last in ONLY_BY_FIRMWARE
            longest_s = robot.period_s * (2 if by_firmware else 1) + 0.03  # the witness looks every 0.01 s
            if not (by_firmware and scene.firmware == "published"):
                if answer_s > longest_s:
                    wrong.append(f"told to move for {answer_s:.2f} s after: {last}")
                late = position[moments > brought_s + longest_s + 0.2]  # wheels run out for 0.2 s
                moved_mm = float(np.linalg.norm(late - late[:1], axis=-1).max()) if len(late) else 0.0
                if moved_mm > 3.0:
                    wrong.append(f"moved by {moved_mm:.0f} mm later than that: {last}")
        if beyond_mm > robot.largest_displacement.forward_mm and not self._is_adrift(scene, last, brought_s):
            wrong.append(f"{beyond_mm:.0f} mm beyond the fence")
        wrong += self._beyond_limits(scene, witness)
        wrong += self._lost_rows(scene, witness)
        if "Traceback" in error or status in (None, 1):
            wrong.append(f"status {status}: {error[-400:]}")
        if brought_s is not None and status not in (0, 3, 130, -signal.SIGKILL):
            wrong.append(f"status {status} after: {last}")
        lines = [line for line in (error + shown).splitlines() if line.strip()]
        return Case(
            number=number,
            survived=survived,
            fault=last if brought_s is not None else "",
            firmware=scene.firmware,
            answer_s=answer_s,
            beyond_mm=round(beyond_mm, 1),
            nearest_mm=round(float(apart.min()), 1),
            status=-99 if status is None else status,
            said=next((line for line in reversed(error.splitlines()) if line.strip()), lines[-1] if lines else "")[
                -300:
            ],
            outcome="; ".join(wrong) or "held",
        )

    def _is_adrift(self, scene: Scene, last: str, brought_s: float | None) -> bool:
        """Whether no host could have stopped the vehicles: the broker is gone, and their firmware drives on."""
        return brought_s is not None and last in ONLY_BY_FIRMWARE and scene.firmware == "published"

    def _beyond_limits(self, scene: Scene, witness: Witness) -> list[str]:
        for _, payload in witness.messages:
            if payload in scene.own:
                continue
            for vehicle, command in scene.message_format.commands(scene.robot.link.command_topic, payload).items():
                if (command < scene.robot.command_low).any() or (command > scene.robot.command_high).any():
                    return [f"vehicle {vehicle} was sent {command.tolist()}"]
        return []

    def _lost_rows(self, scene: Scene, witness: Witness) -> list[str]:
        """Compare the moving commands that the witness saw with those of the recording."""
        seen: collections.Counter[tuple[Any, ...]] = collections.Counter()
        for _, payload in witness.messages:
            if payload not in scene.own:
                for vehicle, command in scene.message_format.commands(scene.robot.link.command_topic, payload).items():
                    if command.any():
                        seen[vehicle, *np.round(command, 3).tolist()] += 1
        if not seen:
            return []
        tables = list(self.project.glob("out/sent.parquet"))
        if not tables:
            journals = list(self.project.glob(".out.partial/**/journal.jsonl"))
            return [] if journals and self._disk_was_full(scene) else ["no recording of a drive"]
        table = pd.read_parquet(tables[0])
        noted: collections.Counter[tuple[Any, ...]] = collections.Counter()
        for row in table[["vehicle", *scene.robot.command_columns]].itertuples(index=False):
            noted[row[0], *np.round(row[1:], 3).tolist()] += 1
        missing = seen - noted
        return [f"{missing.total()} commands are not in the recording"] if missing else []

    def _disk_was_full(self, scene: Scene) -> bool:
        return scene.filled is not None


def _until_rest(moments: np.ndarray, told_to_move: np.ndarray, since_s: float, for_s: float = 0.05) -> float:
    """Return the moment from which vehicles are first told to stand for a while.

    What comes later for a shorter time is a command that a frozen broker had kept, with the zeros behind it.
    """
    ends_s = since_s
    for at_s, moves in zip(moments, told_to_move, strict=True):
        if at_s > since_s and moves:
            if at_s - ends_s > for_s:
                return ends_s
            ends_s = at_s
    return ends_s


def read_cases(state: Path) -> list[Case]:
    """Return the cases of a state file; a last line that was cut off is left out."""
    if not state.exists():
        return []
    lines = state.read_text().split("\n")[:-1]
    return [Case(**json.loads(line)) for line in lines]


def print_table(cases: list[Case]) -> None:
    """Show how often each fault was brought in, how soon it was answered, and what went wrong."""
    print(f"{'fault':38s} {'brought':>8s} {'answer, median':>15s} {'worst':>7s} {'failed':>7s}")
    survived = collections.Counter(name for case in cases for name in case.survived)
    for name in SURVIVABLE:
        if survived[name]:
            print(f"{name:38s} {survived[name]:8d}")
    for name in TO_BE_ANSWERED:
        for firmware in ("published", "time-out") if name in ONLY_BY_FIRMWARE else ("",):
            chosen = [case for case in cases if case.fault == name and firmware in (case.firmware, "")]
            if not chosen:
                continue
            answers = [case.answer_s for case in chosen if case.answer_s is not None]
            failed = sum(case.outcome != "held" for case in chosen)
            title = f"{name} ({firmware} firmware)" if firmware else name
            print(f"{title:38s} {len(chosen):8d} {np.median(answers):13.2f} s {max(answers):5.2f} s {failed:7d}")
    faults = sum(len(case.survived) + bool(case.fault) for case in cases)
    failed = [case for case in cases if case.outcome != "held"]
    print(f"\n{faults} faults in {len(cases)} drives; {len(failed)} drives failed")
    print(f"beyond the fence at most {max(case.beyond_mm for case in cases):.0f} mm (all drives)")
    for case in failed[:40]:
        print(f"  {case.number}: {case.fault or 'no fault to be answered'} after {case.survived}: {case.outcome[:300]}")


def main() -> None:
    """Run the campaign, or show its table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="faults in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--state", type=Path, default=Path("outputs/faults.jsonl"))
    parser.add_argument("--table", action="store_true", help="only show the table")
    options = parser.parse_args()
    cases = read_cases(options.state)
    if not options.table:
        if shutil.which("mosquitto") is None:
            raise SystemExit("mosquitto is needed: apt install mosquitto")
        options.state.parent.mkdir(parents=True, exist_ok=True)
        os.environ["OMP_NUM_THREADS"] = "1"
        place = Path(tempfile.mkdtemp())  # not a TemporaryDirectory: each forked process would remove it at its end
        campaign = Campaign(place, options.seed)
        try:
            with options.state.open("a") as state:
                while sum(len(case.survived) + bool(case.fault) for case in cases) < options.count:
                    case = campaign.run_case(len(cases))
                    cases.append(case)
                    state.write(json.dumps(case._asdict()) + "\n")
                    state.flush()
                    print(f"{case.number:5d} {case.fault:26s} {case.status:4d} {case.outcome[:120]}", flush=True)
        finally:
            campaign.close()
            shutil.rmtree(place, ignore_errors=True)
    if cases:
        print_table(cases)
    sys.exit(1 if any(case.outcome != "held" for case in cases) else 0)


if __name__ == "__main__":
    main()
