"""The control loop: see, predict, decide, make safe, send, note; and whatever happens, stop the vehicles at the end."""

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from swarmtwin.deploy.control.driver import Driver
from swarmtwin.deploy.control.effect_time import EffectTimePredictor
from swarmtwin.deploy.control.heartbeat import Phase
from swarmtwin.deploy.control.journal import Journal, JournalError
from swarmtwin.deploy.control.motion_delay import MotionDelay
from swarmtwin.deploy.control.observer import Observer, SeenPose
from swarmtwin.deploy.control.outcome import Ending, Outcome, Watchmen
from swarmtwin.deploy.control.safety import Decision, SafetyFilter
from swarmtwin.deploy.control.settings import SafetySettings, TimingSettings
from swarmtwin.deploy.control.stop_conditions import StopConditions, all_standing
from swarmtwin.deploy.control.timing import Ticker
from swarmtwin.deploy.link.link import Link, LinkLostError
from swarmtwin.geometry import displacement_between

log = logging.getLogger(__name__)


class Controller:
    """Drives V vehicles of one robot at its control period."""

    def __init__(
        self,
        vehicles: Sequence[str],
        link: Link,
        observer: Observer,
        predictor: EffectTimePredictor,
        safety: SafetyFilter,
        conditions: StopConditions,
        journal: Journal,
        watchmen: Watchmen,
        settings: tuple[SafetySettings, TimingSettings],
    ) -> None:
        self.robot = link.robot
        self.vehicles = tuple(vehicles)
        self.link = link
        self.observer = observer
        self.predictor = predictor
        self.safety = safety
        self.conditions = conditions
        self.journal = journal
        self.watchmen = watchmen
        self.settings, self.timing = settings
        self._delay = MotionDelay(self.robot.period_s, self.robot.displacement_limit)
        self._has_sent = False
        self._outcome = Outcome()
        self._sending_takes_s = 0.01
        self._before: dict[str, SeenPose] = {}

    def run(self, driver: Driver, periods: int) -> Outcome:
        """Drive for so many periods, or until the driver is done, or there is a reason to stop; then stop.

        The vehicles have been told to stand, and seen to or not, when this returns or raises.
        """
        self._outcome = Outcome()
        try:
            self._drive(driver, periods)
        except (LinkLostError, JournalError) as error:
            self._end("stopped", str(error))
        except BaseException as error:
            self._end("stopped", f"a defect: {type(error).__name__}: {error}")
            raise
        finally:
            self._stop()
        return self._outcome

    def _drive(self, driver: Driver, periods: int) -> None:
        if not self._beat():
            return
        driver.start(np.array([self.observer.newest()[vehicle].pose for vehicle in self.vehicles]))
        if self.watchmen.heartbeat:
            self.watchmen.heartbeat.phase = Phase.DRIVING
        ticker = Ticker(self.robot.period_s, time.monotonic() + self.robot.period_s / 4)
        self._outcome.lateness_s = ticker.lateness_s
        sent: Decision | None = None
        for tick in range(periods + 1):
            due_s = ticker.due_s
            if not ticker.wait(self._beat, self.timing.beat_s):
                return
            with self.observer.quiet():
                period = self._period(driver, tick, due_s, sent, tick == periods)
            if period is None:
                return
            seen, sent = period
            if not self._watch(tick, seen):
                return
            self._show(tick, seen, sent, driver)
            self._follow_camera(ticker, due_s)

    def _period(
        self, driver: Driver, tick: int, due_s: float, before: Decision | None, is_last: bool
    ) -> tuple[dict[str, SeenPose], Decision] | None:
        """See, predict, decide, make safe, send and note; return what was seen and sent, None where it is the end."""
        seen = self.observer.newest()
        if not self._beat():
            return None
        pose = np.array([seen[vehicle].pose for vehicle in self.vehicles])
        captured_s = np.array([seen[vehicle].captured_s for vehicle in self.vehicles])
        effect_s = time.monotonic() + self._sending_takes_s + self._latency_s()
        state = self.predictor.predict(pose, captured_s, effect_s)
        predicted = self.predictor.measured(state)
        if before is not None and (done := driver.moved(before.command, predicted)):
            self._end("done", done)
            return None
        if is_last:
            self._end("done", f"{tick} periods are over")
            return None
        asked_s = time.monotonic()
        requested = self._decide(driver, predicted)
        if requested is None:
            return None
        decided_s = time.monotonic()
        decision = self.safety(state, requested)
        safe_s = time.monotonic()
        if not self._beat():
            return None
        sent_s = self._send(tick, due_s, decision, requested, (pose, captured_s, predicted))
        self._sending_takes_s += 0.2 * (sent_s - asked_s + 0.002 - self._sending_takes_s)
        self.predictor.command_sent(state, decision.command, sent_s + self._latency_s())
        self.conditions.note_sent(sent_s, decision.command)
        outcome = self._outcome
        outcome.periods = tick + 1
        outcome.camera_to_command_s.append(sent_s - float(captured_s.min()))
        outcome.decision_s.append(decided_s - asked_s)
        outcome.filter_s.append(safe_s - decided_s)
        return seen, decision

    def _decide(self, driver: Driver, predicted: np.ndarray) -> np.ndarray | None:
        started_s = time.monotonic()
        try:
            requested = driver.decide(predicted)
        except Exception as error:  # whatever it is: vehicles do not go on without a decision
            self._end("stopped", f"no decision: {' '.join(str(error).split()) or type(error).__name__}")
            return None
        if reason := self.conditions.of_decision(requested, time.monotonic() - started_s):
            self._end("stopped", reason)
            return None
        return requested

    def _beat(self) -> bool:
        """Show that the controller lives, and look for a reason to stop; return whether to go on."""
        now_s = time.monotonic()
        heartbeat = self.watchmen.heartbeat
        if heartbeat:
            heartbeat.write("controller_beat_s", now_s)
            if reason := self.conditions.of_supervisor(now_s, heartbeat, self.watchmen.supervisor_lives()):
                return self._end("stopped", reason)
            if heartbeat.read("stop_requested"):
                return self._end("stopped", "emergency stop on the page")
        if reason := self.watchmen.interrupts.reason:
            return self._end("interrupted" if self.watchmen.interrupts.signalled else "stopped", reason)
        reason = (
            self.conditions.of_pictures(now_s, self.observer)
            or self.conditions.of_poses(now_s, self.observer.newest(), self.observer.doubts)
            or self.conditions.of_link(self.link)
            or self.conditions.of_obedience(now_s, self.observer)
        )
        return self._end("stopped", reason) if reason else True

    def _end(self, ending: Ending, reason: str) -> bool:
        if not self._outcome.reason:
            self._outcome.ending, self._outcome.reason = ending, reason
        return False

    def _latency_s(self) -> float:
        if self.timing.link_latency_s is not None:
            return self.timing.link_latency_s
        measured_s = getattr(self.link, "round_trip_s", 0.0)
        return (measured_s if np.isfinite(measured_s) else 0.0) + self._delay.delay_s

    def _send(
        self,
        tick: int,
        due_s: float,
        decision: Decision,
        requested: np.ndarray,
        poses: tuple[np.ndarray, np.ndarray, np.ndarray],
    ) -> float:
        """Note what is about to be sent, send it, note that it was; return when."""
        commands = dict(zip(self.vehicles, decision.command, strict=True))
        self.journal.write("sending", tick=tick, now_s=time.monotonic(), sent=commands)
        sent_s = self.link.send(commands)
        self._has_sent = True
        pose, captured_s, predicted = poses
        watch = self.watchmen.expectation
        self.journal.write(
            "period",
            tick=tick,
            due_s=due_s,
            sent_s=sent_s,
            vehicles=self.vehicles,
            captured_s=captured_s,
            pose=pose.round(4),
            predicted=predicted.round(4),
            requested=requested,
            sent=decision.command,
            reason=decision.reasons,
            alarm=[] if watch is None else watch.alarm,
        )
        return sent_s

    def _watch(self, tick: int, seen: Mapping[str, SeenPose]) -> bool:
        """Compare what each vehicle did since the last period with what is expected; return whether to go on."""
        watch, before = self.watchmen.expectation, self._before
        self._before = dict(seen)
        if not before:
            return True
        start, end = ([which[vehicle] for vehicle in self.vehicles] for which in (before, seen))
        start_s, end_s = (np.array([one.captured_s for one in which]) for which in (start, end))
        true = [self.predictor.true_poses([one.pose for one in which]) for which in (start, end)]
        self._delay.update(self.predictor, (true[0], start_s), (true[1], end_s))
        self._outcome.motion_delay_s.append(self._latency_s())
        if watch is None:
            return True
        measured = displacement_between(*true)
        for vehicle in watch.update(self.predictor.motion_between(start_s, end_s), measured, end_s - start_s):
            words = watch.words(vehicle)
            self.journal.write("alarm", tick=tick, vehicle=self.vehicles[vehicle], words=words)
            log.warning("%s: diagnose this recording afterwards", words)
        if watch.is_severe.any():
            worst = int(np.argmax(watch.is_severe))
            return self._end("stopped", f"vehicle {self.vehicles[worst]} is out of control: {watch.words(worst)}")
        return True

    def _show(self, tick: int, seen: Mapping[str, SeenPose], decision: Decision, driver: Driver) -> None:
        watch = self.watchmen.expectation
        under = watch.is_under_alarm if watch else np.zeros(len(self.vehicles), bool)
        self.watchmen.publish(
            {
                "tick": tick,
                "now_s": time.monotonic(),
                "vehicles": {
                    vehicle: {
                        "pose": seen[vehicle].pose.tolist(),
                        "captured_s": seen[vehicle].captured_s,
                        "sent": decision.command[index].tolist(),
                        "scale": float(decision.scale[index]),
                        "reason": decision.reasons[index],
                        "alarm": bool(under[index]),
                    }
                    for index, vehicle in enumerate(self.vehicles)
                },
                "interventions": self.safety.interventions,
                "deadlocks": self.safety.deadlocks,
                "lateness_ms": 1000 * self._outcome.lateness_s[-1],
                "camera_to_command_ms": 1000 * self._outcome.camera_to_command_s[-1],
                **driver.shown(),
            }
        )

    def _follow_camera(self, ticker: Ticker, due_s: float) -> None:
        """Let the next period begin just after a picture's poses are known: then they are as new as they can be."""
        if not self.timing.follow_camera:
            return
        known_s = self.observer.known_around(due_s)
        if known_s is None:
            return
        ticker.shift(known_s + self.timing.after_picture_s - due_s, self.timing.largest_shift)

    def _stop(self) -> None:
        """Tell all vehicles to stand, again and again, until they are seen to; no failure of one way ends another."""
        outcome, heartbeat, settings = self._outcome, self.watchmen.heartbeat, self.settings
        if heartbeat:
            heartbeat.phase = Phase.STOPPING
            if outcome.ending != "done":
                heartbeat.write("ask_supervisor", 1)
        log.info("stop: %s", outcome.reason)
        zeros = dict.fromkeys(self.vehicles, self.robot.command_at_rest)
        begun_s = time.monotonic()
        next_s = begun_s
        while True:
            now_s = time.monotonic()
            if heartbeat:
                heartbeat.write("controller_beat_s", now_s)
            if now_s >= next_s:
                next_s = now_s + settings.zeros_every_s
                with suppress(LinkLostError, JournalError):
                    sent_s = self.link.send(zeros)
                    outcome.stopped_s = min(sent_s, outcome.stopped_s) if outcome.stopped_s > 0 else sent_s
                    self.journal.write("stop", sent_s=sent_s, sent=zeros, reason=outcome.reason)
            outcome.is_standing = all_standing(self.observer, self.vehicles, settings, now_s, begun_s)
            if outcome.is_standing or now_s > begun_s + settings.standstill_wait_s or not self._has_sent:
                break
            time.sleep(min(0.02, settings.zeros_every_s))
        with suppress(JournalError):
            self.journal.write(
                "end", ending=outcome.ending, reason=outcome.reason, is_standing=outcome.is_standing, now_s=now_s
            )
        if self._has_sent and not outcome.is_standing:
            log.error("the vehicles could not be seen to stand: look at them")
