"""Everything that can be set of a deployment's control and safety, with a reason for each number."""

from typing import Annotated

from pydantic import AfterValidator, Field

from swarmtwin.robot import Positive, Robot, StrictModel

Share = Annotated[float, Field(gt=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]


def _from_whole_to_nothing(scales: tuple[float, ...]) -> tuple[float, ...]:
    if scales[:1] != (1.0,) or scales[-1:] != (0.0,) or list(scales) != sorted(set(scales), reverse=True):
        raise ValueError("scales must fall from 1 to 0")
    return scales


class SafetySettings(StrictModel):
    """When a command is weakened, when all vehicles are stopped, and what a stop is. `conf/safety/default.yaml`.

    Attributes:
        separation_mm: commands are weakened that may bring two centres nearer than this; null: a tenth more than what
            the task calls a collision, or where it knows none, 1.3 times the vehicle's longer side.
        fence_margin_mm: commands are weakened that may bring a centre nearer than this to the arena's border.
        obstacle_margin_mm: or nearer than this to an obstacle, as round things that touch.
        deviations: how many standard deviations of the motion "may" means.
        unknown_spread: where the simulation does not know how random motion is: its standard deviation, as a share of
            the motion.
        look_ahead_periods: 1: where the command leads; 2: and where the vehicle is after standing still for another.
        scales: what a command may be weakened to, in this order.
        deadlock_periods: a vehicle whose command has been withheld for so many periods in a row is in a deadlock.
        pose_age_s: all stop when a vehicle has not been seen for so long.
        picture_age_s: or when no picture has come for so long.
        outside_mm: all stop when a vehicle's centre is further than this beyond the arena's border.
        too_near_mm: or when two centres are nearer than this; null: nine tenths of what the task calls a collision.
        decision_s: or when the policy takes longer than this for its decision.
        standing_moves_mm: or when a vehicle that has been told to stand for two periods moves further than this in one.
        heartbeat_s: the supervisor stops all when the controller has shown no sign of life for so long; null: half a
            period. The controller stops all when the supervisor has shown none for half as long again.
        zeros_every_s: a stop is repeated that often until the vehicles are seen to stand.
        standstill_s: they stand when they have not moved for so long
        standstill_mm: by more than this.
        standstill_wait_s: zeros are repeated for so long at most, and if they do not stand by then, the stop says so;
            robots that have lost the broker take 5 s to come back to it.
    """

    separation_mm: Positive | None = None
    fence_margin_mm: NotNegative = 5.0
    obstacle_margin_mm: NotNegative = 5.0
    deviations: NotNegative = 3.0
    unknown_spread: NotNegative = 0.25
    look_ahead_periods: Annotated[int, Field(ge=1, le=2)] = 2
    scales: Annotated[tuple[float, ...], AfterValidator(_from_whole_to_nothing)] = (1.0, 0.75, 0.5, 0.25, 0.0)
    deadlock_periods: Count = 10
    pose_age_s: Positive = 0.3
    picture_age_s: Positive = 0.3
    outside_mm: NotNegative = 15.0
    too_near_mm: Positive | None = None
    decision_s: Positive = 0.1
    standing_moves_mm: Positive = 15.0
    heartbeat_s: Positive | None = None
    zeros_every_s: Positive = 0.05
    standstill_s: Positive = 0.5
    standstill_mm: Positive = 3.0
    standstill_wait_s: Positive = 10.0

    def heartbeat_limit_s(self, robot: Robot) -> float:
        """Return how old the controller's last sign of life may be."""
        return self.heartbeat_s or robot.period_s / 2


class TimingSettings(StrictModel):
    """When the controller acts. In `conf/deploy.yaml` and `conf/collect.yaml`.

    Attributes:
        link_latency_s: from sending a command until it acts, by which poses are predicted ahead; null: as the link
            measures it, and what the vehicles' motion shows beyond that.
        beat_s: how often the controller looks for a reason to stop, and shows that it lives.
        follow_camera: shift the periods, by `largest_shift` at most, so that each begins just after a picture.
        largest_shift: of a period's length, as a share of it.
        after_picture_s: how long after a picture's poses are known a period should begin.
    """

    link_latency_s: NotNegative | None = None
    beat_s: Positive = 0.02
    follow_camera: bool = True
    largest_shift: Annotated[float, Field(ge=0, le=0.1)] = 0.01
    after_picture_s: NotNegative = 0.002


class WatchSettings(StrictModel):
    """How a vehicle that does not behave as the simulation expects is recognised. `conf/watch/default.yaml`.

    Attributes:
        periods_between_false_alarms: a vehicle with which nothing is wrong is named once in so many periods on average,
            or less often.
        tails: degrees of freedom of the t distribution that standardised residuals are taken to have; fewer, heavier.
        unit_spread: by which share a unit's speeds differ from the drawing's where nothing is wrong (standard
            deviation), both of the vehicle and of the one that was recorded; null: as the robot's file says.
        usual_unit_spread: where that says nothing: cheap gear motors are sold with ±10 %, two standard deviations.
        unit_alarm_periods: the chance to take a unit for strange that is none is that of a false alarm in so many
            periods, once for all.
        motion_spread: random part of the motion, as a share of it, beyond what the simulation states.
        timing_spread_s: how well it is known when a command takes effect (standard deviation).
        least_spread_mm: the residual's standard deviation is at least this, by camera and interpolation.
        least_spread_rad: likewise for turns.
        simulation_error: by how much the simulation itself errs, as long as vehicles go on alike (standard deviation):
            a share of the noise that it states, since a learned model is not right everywhere.
        error_persists: how much of that error is left one period later.
        changes: by which shares speeds or a wheel may have changed of a vehicle that is not as it was.
        lag_shares: which share of the motion before may be left in a period of a vehicle that follows gradually.
        severe_periods: a vehicle under alarm that has moved otherwise than expected for so many periods in a row
        severe_share: by more than this share of the robot's largest believable displacement stops the group.
    """

    periods_between_false_alarms: Annotated[float, Field(gt=1)] = 10_000.0
    tails: Annotated[float, Field(gt=2)] = 6.0
    unit_spread: Positive | None = None
    usual_unit_spread: Positive = 0.05
    unit_alarm_periods: Positive = 50.0
    motion_spread: NotNegative = 0.05
    timing_spread_s: NotNegative = 0.03
    least_spread_mm: Positive = 0.7
    least_spread_rad: Positive = 0.01
    simulation_error: NotNegative = 1.0
    error_persists: Annotated[float, Field(ge=0, lt=1)] = 0.9
    changes: Annotated[tuple[float, ...], Field(min_length=1)] = (-1.0, -0.6, -0.3, -0.15, 0.2, 0.4)
    lag_shares: tuple[float, ...] = (0.2, 0.5)
    severe_periods: Count = 4
    severe_share: Positive = 0.4
