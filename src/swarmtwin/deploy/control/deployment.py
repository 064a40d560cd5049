"""One deployment from the first look to the last zero: everything opened, checked, driven, and let go in its order."""

import contextlib
import gc
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch

from swarmtwin.deploy.camera.camera import Camera, Frame
from swarmtwin.deploy.control.controller import Controller
from swarmtwin.deploy.control.deployment_recording import SUPERVISOR_LOG, write_about
from swarmtwin.deploy.control.driver import Driver
from swarmtwin.deploy.control.effect_time import EffectTimePredictor
from swarmtwin.deploy.control.expectation import Expectation
from swarmtwin.deploy.control.heartbeat import Heartbeat, Phase
from swarmtwin.deploy.control.interrupts import Interrupts
from swarmtwin.deploy.control.journal import JOURNAL, Journal
from swarmtwin.deploy.control.look_ahead import LookAhead
from swarmtwin.deploy.control.observer import Observer, Tracks
from swarmtwin.deploy.control.outcome import Outcome, Watchmen
from swarmtwin.deploy.control.plan import Plan
from swarmtwin.deploy.control.safety import SafetyFilter
from swarmtwin.deploy.control.stop_conditions import StopConditions
from swarmtwin.deploy.control.supervisor import Orders, SupervisorProcess
from swarmtwin.deploy.link.link import Link
from swarmtwin.deploy.live_view.view_process import LiveView
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.errors import UserError

log = logging.getLogger(__name__)


class Deployment:
    """The open deployment; leaving the block lets everything go, whatever has happened.

    Attributes:
        plan: what it is to be.
        link: to the vehicles.
        observer: sees them.
        expectation: watches them; None: nothing does.
        journal: of what happened.
        interrupts: from outside.
        supervisor: the process beside; None: there is none.
        view: the live view; None: there is none.
        interventions: commands weakened so far, in all drives.
        deadlocks: vehicles held back for long so far.
    """

    def __init__(
        self,
        plan: Plan,
        link: Link,
        camera: Camera,
        tracker: Tracks,
        folder: Path,
        about: Mapping[str, Any],
        view: LiveView | None = None,
    ) -> None:
        """Prepare.

        Args:
            plan: what it is to be.
            link: connected to the vehicles.
            camera: sees them.
            tracker: finds them on its pictures.
            folder: an existing one, for the journal.
            about: of `deployment.yaml`, from which a killed deployment is finished.
            view: for people to look at, started; None: nobody looks.
        """
        self.plan = plan
        self.link = link
        self.view = view
        self.interrupts = Interrupts()
        self.supervisor: SupervisorProcess | None = None
        self.expectation = Expectation(plan.simulation, plan.vehicles, plan.watch) if plan.watches else None
        self.interventions = 0
        self.deadlocks = 0
        self._folder = folder
        self._about = about
        self._switch_interval_s = sys.getswitchinterval()
        self._shared = Path(tempfile.mkdtemp(prefix="swarmtwin-"))
        self.observer = Observer(camera, tracker, plan.vehicles, self._on_sighting)

    def __enter__(self) -> Self:
        try:
            write_about(self._folder, self._about)
            self.journal = Journal(self._folder / JOURNAL, self.plan.journal_bytes)
            self.heartbeat = self.view.heartbeat if self.view else Heartbeat.create(self._shared / "heartbeat")
            self._start_supervisor()
            self._priority = os.getpriority(os.PRIO_PROCESS, 0)
            with contextlib.suppress(PermissionError):  # where it is allowed, control comes before everything else
                os.setpriority(os.PRIO_PROCESS, 0, min(self._priority, -10))
            sys.setswitchinterval(0.0005)  # a thread that has to decide must not wait 5 ms for one that looks
            self.observer.start()
            gc.collect()
            gc.freeze()  # a collection of all that was imported would take longer than a period's lateness may be
            torch.set_num_threads(1)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close()

    def wait_for_vehicles(self) -> np.ndarray:
        """Wait until all vehicles are seen, and may be driven from where they are; return their poses (V, 3).

        Raises:
            UserError: one is not seen, or they stand where none may.
        """
        until_s = time.monotonic() + self.plan.wait_s
        while missing := self._missing():
            if self.observer.failure:
                raise UserError(f"{self.observer.failure}; nothing has moved")
            if reason := self.interrupts.reason:
                raise KeyboardInterrupt(f"{reason}; nothing has moved")
            if time.monotonic() > until_s:
                doubts = self.observer.doubts
                because = "".join(f" ({doubts[vehicle]})" for vehicle in missing[:1] if vehicle in doubts)
                raise UserError(
                    f"vehicle {', '.join(missing)} not seen{because}: put it under the camera, look whether its marker "
                    f"is that of its id, or name the vehicles that are there: vehicles=[...]"
                )
            time.sleep(0.02)
        seen = self.observer.newest()
        pose = np.array([seen[vehicle].pose for vehicle in self.plan.vehicles])
        if reason := self._conditions().of_positions(pose[:, :2]):
            raise UserError(f"{reason}: put the vehicles apart and inside before they are driven")
        return pose

    def drive(self, driver: Driver, periods: int, run: str) -> Outcome:
        """Drive for so many periods or until the driver is done, then stop."""
        plan = self.plan
        self.journal.write("run", name=run)
        safety = SafetyFilter(
            plan.robot,
            plan.arena,
            plan.vehicles,
            LookAhead(plan.simulation, plan.safety.look_ahead_periods, plan.safety.unknown_spread),
            plan.safety,
            plan.separation_mm,
            self._as_sent,
            plan.obstacle_table,
        )
        self._warm_up(safety)
        controller = Controller(
            plan.vehicles,
            self.link,
            self.observer,
            EffectTimePredictor(plan.simulation, len(plan.vehicles)),
            safety,
            self._conditions(),
            self.journal,
            Watchmen(
                heartbeat=self.heartbeat,
                supervisor_lives=self.supervisor.is_alive if self.supervisor else lambda: True,
                publish=self.view.publish if self.view else lambda state: None,
                interrupts=self.interrupts,
                expectation=self.expectation,
            ),
            (plan.safety, plan.timing),
        )
        with self.interrupts.heeded():
            outcome = controller.run(driver, periods)
        self.interventions += safety.interventions
        self.deadlocks += safety.deadlocks
        return outcome

    def _conditions(self) -> StopConditions:
        plan = self.plan
        return StopConditions(plan.robot, plan.arena, plan.vehicles, plan.safety, plan.too_near_mm, plan.obstacle_table)

    def _as_sent(self, command: np.ndarray) -> np.ndarray:
        written = getattr(self.link, "message_format", None)
        return command if written is None else written.as_sent(command)

    def _missing(self) -> list[str]:
        seen, now_s = self.observer.newest(), time.monotonic()
        fresh_s = self.plan.safety.pose_age_s
        return [one for one in self.plan.vehicles if one not in seen or now_s - seen[one].captured_s > fresh_s]

    def _warm_up(self, safety: SafetyFilter) -> None:
        """Let everything compute once that the first period will: what is first is slow."""
        plan = self.plan
        state = plan.simulation.start(torch.zeros(1, len(plan.vehicles), 3))
        rest = np.tile(plan.robot.command_at_rest, (len(plan.vehicles), 1))
        for _ in range(3):
            safety(state, rest)

    def _start_supervisor(self) -> None:
        plan = self.plan
        if plan.link is None:
            self.heartbeat.write("supervisor_beat_s", np.inf)
            return
        output = self._folder.parent
        name = output.name.removeprefix(".").removesuffix(".partial")
        orders = Orders(
            heartbeat=self.heartbeat.path,
            vehicles=plan.vehicles,
            silence_s=plan.safety.heartbeat_limit_s(plan.robot),
            zeros_every_s=plan.safety.zeros_every_s,
            log=self._folder / SUPERVISOR_LOG,
            recover=output.with_name(name) if output.name.endswith(".partial") else None,
            link=dict(plan.link),
        )
        self.supervisor = SupervisorProcess(orders)
        if problem := self.supervisor.wait_until_ready(self.heartbeat):
            raise UserError(f"the supervisor could not start: {problem}")

    def _on_sighting(self, sighting: Sighting, frame: Frame) -> None:
        self.journal.sighting(sighting)
        if self.view:
            self.view.show_picture(frame.image, sighting)

    def _close(self) -> None:
        if hasattr(self, "heartbeat"):
            self.heartbeat.phase = Phase.ENDED
        self.observer.close()
        sys.setswitchinterval(self._switch_interval_s)
        if hasattr(self, "_priority"):
            os.setpriority(os.PRIO_PROCESS, 0, self._priority)
        if self.supervisor:
            self.supervisor.close()
        if hasattr(self, "journal"):
            self.journal.close()
        gc.unfreeze()
        shutil.rmtree(self._shared, ignore_errors=True)
