"""A two-wheeled car with a caster, sister of the Micro-Ground Robot: contact, gear motors, friction in the bearings."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Placement
from swarmtwin.standin.effects.gain_change import GainChange
from swarmtwin.standin.physics import fabricate
from swarmtwin.standin.rigid_body.machine import Machine, Moment


class Car(Machine):
    """PWM → voltage → motor current → gear → wheel on the floor; a caster slides behind.

    A motor's torque is that of its constant and the voltage that its own speed leaves (back-EMF), so it lags by its
    rotor's inertia and the car's. Bearings rub (Coulomb), tyres grip and caster slides by contact friction. Gain is
    another wheel radius; sag and unlike sides are voltages; added lag is a heavier rotor; backlash is play between gear
    and wheel, which are then two bodies. A bad surface resists each wheel's rolling where that wheel is, by the share
    of its speed that a motor loses; a drift is a floor that carries, as a conveyor belt does. Chance is a torque in
    each gear, in proportion to its speed.

    Attributes:
        spreads: standard deviation of each property's factor from unit to unit, in the order in which they are drawn.
        full_pwm: the largest command.
        full_voltage: the battery's, given to a motor at the largest command.
        motor_constant: V·s/rad, equally N·m/A, at the motor's shaft.
        resistance: of a motor, Ω.
        gear: turns of the motor to one of the wheel.
        rotor_inertia: of a motor, kg·m², with the gear.
        last_stage_inertia: of the part of it behind the play, at the wheel: a wheel alone, far lighter, would stand
            within a time step on a bad floor, and its tyre would slide.
        wheel_radius: m.
        track: between the wheels' contacts, m.
        mass: of the body without wheels, kg.
        gear_friction, wheel_friction: Coulomb friction of a bearing before and behind the play, N·m at the wheel.
        tyre_grip, caster_grip: coefficients of contact friction.
        slip_noise_sqrt_s: random part of a wheel's travel: standard deviation over one second, as a share of it.
    """

    spreads: ClassVar[Mapping[str, float]] = {
        **{
            f"{side}_{name}": spread
            for name, spread in (("motor", 0.015), ("radius", 0.01))
            for side in ("left", "right")
        },
        **{f"{side}_friction": 0.08 for side in ("left", "right")},
        **{"track": 0.015, "mass": 0.03, "rotor": 0.05, "caster_grip": 0.1},
    }
    command_columns = ("left", "right")
    resting_command = (0.0, 0.0)
    steps = 100
    pieces = 10
    noises = 2
    camera_noise = (0.85, 0.85, 0.016)

    full_pwm = 120.0
    full_voltage = 2.25
    motor_constant = 0.007
    resistance = 43.0
    gear = 50.0
    rotor_inertia = 3.5e-8
    last_stage_inertia = 1e-5
    wheel_radius = 0.016
    track = 0.070
    mass = 0.18
    gear_friction = 0.0011
    wheel_friction = 0.0006
    tyre_grip = 0.6
    caster_grip = 0.15
    slip_noise_sqrt_s = 0.05

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        effects = self.conditions.effects
        self._gain = float(np.prod([effect.gain for effect in effects if isinstance(effect, GainChange)]))
        supplying = [effect for effect in effects if not isinstance(effect, GainChange)]
        self.supply = ActiveEffects(self.conditions.robot, supplying)
        self.factor = fabricate("mgr/rigid_body", self.vehicles, self.spreads)

    @property
    def _viscous(self) -> np.ndarray:
        """Torque that each motor's own speed takes from its wheel, N·m·s/rad, (2, 1, V)."""
        return (self._sides("motor") * self.motor_constant * self.gear) ** 2 / self.resistance

    @property
    def _track(self) -> np.ndarray:
        """Distance between the wheels' contacts, m, (V,)."""
        return self.factor["track"] * self.track

    def _sides(self, name: str) -> np.ndarray:
        """Return the factors (2, 1, V) of left and right."""
        return np.stack([self.factor[f"left_{name}"], self.factor[f"right_{name}"]])[:, None]

    def describe(self, vehicle: int) -> str:
        """Describe the floor, the body with its caster, and both drives."""
        of = {name: float(factor[vehicle]) for name, factor in self.factor.items()}
        x_m_s, y_m_s = np.array(self.carrying_mm_s) / 1000
        drives = [self._describe_drive(side, vehicle) for side in ("left", "right")]
        bodies, plays, motors = ("".join(parts) for parts in zip(*drives, strict=True))
        driven = "{}_gear" if self.conditions.backlash else "{}"
        slips = "".join(f'<motor joint="{driven.format(side)}"/>' for side in ("left", "right"))
        floors = "".join(f'<general joint="{side}" gaintype="affine" gainprm="0 0 -1"/>' for side in ("left", "right"))
        return f"""
        <mujoco>
          <option timestep="{self.time_step_s}" integrator="implicitfast" cone="elliptic" impratio="10"/>
          <worldbody>
            <geom type="plane" size="0 0 1" surfacevel="{x_m_s} {y_m_s} 0 0 0 0"/>
            <body>
              <freejoint/>
              <inertial pos="-0.008 0 0.018" mass="{self.mass * of["mass"]}" diaginertia="8e-5 9e-5 1.2e-4"/>
              <geom type="sphere" size="0.005" pos="-0.035 0 0.005" priority="1"
                    friction="{self.caster_grip * of["caster_grip"]} 0 0"/>
              {bodies}
            </body>
          </worldbody>
          <tendon>{plays}</tendon>
          <actuator>{motors}{slips}{floors}</actuator>
        </mujoco>"""

    def _describe_drive(self, side: str, vehicle: int) -> tuple[str, str, str]:
        """Describe the wheel on one side, with its gear where there is play, the play, and the motor."""
        of = {name: float(self.factor[f"{side}_{name}"][vehicle]) for name in ("motor", "radius", "friction")}
        radius = self.wheel_radius * of["radius"] * self._gain
        motor_constant = self.motor_constant * of["motor"]
        left = float(self._track[vehicle]) / 2 * (1 if side == "left" else -1)
        gear_friction, wheel_friction = self.gear_friction * of["friction"], self.wheel_friction * of["friction"]
        inertia = self.rotor_inertia * float(self.factor["rotor"][vehicle])
        inertia += self.conditions.lag_s * motor_constant**2 / self.resistance
        gear, play, last_stage = "", "", 0.0
        driven = f"{side}_gear" if self.conditions.backlash else side
        if self.conditions.backlash:
            half_rad = self.conditions.backlash / 2000 / radius
            last_stage = min(self.last_stage_inertia, inertia * self.gear**2 / 2)
            inertia -= last_stage / self.gear**2
            gear = f"""
            <body pos="0 {0.7 * left} {radius}">
              <inertial pos="0 0 0" mass="0.001" diaginertia="1e-8 1e-8 1e-8"/>
              <joint name="{driven}" axis="0 1 0" frictionloss="{gear_friction}"/>
            </body>"""
            play = f"""
            <fixed limited="true" range="{-half_rad} {half_rad}" solreflimit="0.012 1">
              <joint joint="{side}" coef="1"/><joint joint="{driven}" coef="-1"/>
            </fixed>"""
        else:
            wheel_friction += gear_friction
        wheel = f"""
        <body pos="0 {left} {radius}">
          <joint name="{side}" axis="0 1 0" frictionloss="{wheel_friction}" damping="1e-5"
                 armature="{last_stage}"/>
          <geom type="ellipsoid" size="{radius} 0.004 {radius}" mass="0.008" priority="1"
                friction="{self.tyre_grip} 0 0"/>
        </body>"""
        motor = f"""
        <dcmotor joint="{driven}" gear="{self.gear}" motorconst="{motor_constant}" resistance="{self.resistance}"
                 armature="{inertia}"/>"""
        return gear + wheel, play, motor

    def at_pose(self, pose: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Turn and shift what has settled on the floor at the origin."""
        half_rad = pose[..., 2] / 2
        cos, sin = np.cos(half_rad), np.sin(half_rad)
        w, x, y, z = np.moveaxis(position[..., 3:7], -1, 0)
        turned = position.copy()
        turned[..., :2] = pose[..., :2] / 1000
        turned[..., 3:7] = np.stack(
            [cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w], axis=-1
        )
        return turned

    def pose(self, position: np.ndarray) -> np.ndarray:
        """Take the place under the middle of the axle, and the yaw."""
        w, x, y, z = np.moveaxis(position[..., 3:7], -1, 0)
        yaw_rad = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
        return np.stack([position[..., 0] * 1000, position[..., 1] * 1000, yaw_rad])

    def target(self, command: np.ndarray, strength: Any) -> np.ndarray:
        """Return the motors' voltages (2, R, V)."""
        return command / self.full_pwm * self.full_voltage * strength

    def controls(self, target: np.ndarray, moment: Moment) -> np.ndarray:
        """Return both voltages, then both random torques (N·m), then both floors' resistances (N·m·s/rad)."""
        speed_rad_s = np.moveaxis(moment.velocity[..., self._driven_joints], -1, 0)
        size = self.slip_noise_sqrt_s * self.conditions.noise_factor / np.sqrt(moment.piece_s)
        slip = self._viscous * size * speed_rad_s * moment.noise
        resistance = self._viscous * (1.0 / self._traction(moment) - 1.0)
        held = np.broadcast_to(np.concatenate([slip, resistance])[:, None], (4, *target.shape[1:]))
        return np.ascontiguousarray(np.moveaxis(np.concatenate([target, held]), (0, 1), (-1, -2)))

    @property
    def _driven_joints(self) -> list[int]:
        """Which of the velocities, behind the body's six, are those of the joints that the motors drive."""
        return [6, 8] if self.conditions.backlash else [6, 7]

    def _traction(self, moment: Moment) -> Any:
        """Return the factor (2, R, V) on how far a voltage brings each wheel, where it touches the floor."""
        x_mm, y_mm, heading_rad = moment.pose
        left_mm = np.array([500.0, -500.0]).reshape(2, 1, 1) * self._track
        none = np.empty((0, *left_mm.shape[:1], *x_mm.shape))
        x_mm, y_mm = x_mm - left_mm * np.sin(heading_rad), y_mm + left_mm * np.cos(heading_rad)
        heading_rad = np.broadcast_to(heading_rad, x_mm.shape)
        place = Placement(moment.period.progress, x_mm, y_mm, heading_rad, none, none)
        return np.broadcast_to(self.conditions.traction(place), x_mm.shape)
