"""A planar swimmer with a servo and a fin that bends, sister of the Micro-Underwater Robot, in the engine's fluid."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.standin.effect import Placement
from swarmtwin.standin.physics import fabricate
from swarmtwin.standin.rigid_body.machine import Machine, Moment


class Swimmer(Machine):
    """Fin's mean angle, amplitude and frequency → servo → stiff plate → plate on a spring → forces of the water.

    Hull and plates are ellipsoids in MuJoCo's fluid: added mass, drag, lift by circulation. Nothing here says how fast
    it swims or turns: that follows from the plates' strokes, of which a period holds half a one to a whole. The hull
    stays level and touches the pool's walls. Gain and supply are the strokes' size; added lag and play lie between
    command and plates; weeds and walls resist the hull; a drift is a current. Chance is eddies that push the hull.

    Attributes:
        spreads: standard deviation of each property's factor, of the trim in rad, in the order in which they are drawn.
        hull, plate, tail: semi-axes of the ellipsoids, m: along, across, upright.
        mass: of the hull, kg.
        inertia: of the hull about its upright axis, kg·m².
        horn, loose_horn: inertia of the servo's horn, kg·m²; the latter with play behind it, whose stop is too soft for
            one as light as the former at this time step. A swimmer is 0.2 % faster with it.
        plate_mass, tail_mass: with the water that they must accelerate, which the engine leaves to the body, kg.
        hull_fluid, fin_fluid: MuJoCo's coefficients: blunt drag, slender drag, angular drag, Kutta lift, Magnus lift.
        stiffness: of the spring between both plates, N·m/rad.
        bend_damping, play_damping: of that joint, and of the play behind the servo, N·m·s/rad.
        ripples: linear drag by the waves that the hull makes at the surface, N·s/m and N·m·s/rad.
        servo_gain, servo_damping: of the servo's own controller, N·m/rad and N·m·s/rad.
        servo_torque: its largest, N·m.
        setting_s: time constant with which the controller takes over a new mean, amplitude and frequency.
        water: density in kg/m³.
        eddies: random accelerations ahead and sideways, m/s per √s, and of turning, rad/s per √s.
    """

    spreads: ClassVar[Mapping[str, float]] = {
        **{"mass": 0.03, "drag": 0.03, "stiffness": 0.04, "chord": 0.02, "span": 0.015, "trim": 0.02},
    }
    command_columns = ("mean_angle_deg", "amplitude_deg", "frequency_rad_s")
    resting_command = (0.0, 0.0, 3.0)
    steps = 160
    pieces = 16
    noises = 3
    settling_steps = 800
    camera_noise = (1.3, 1.3, 0.012)

    hull = (0.0855, 0.053, 0.0162)
    plate = (0.024, 0.003, 0.034)
    tail = (0.046, 0.002, 0.022)
    mass = 0.3
    inertia = 0.00079
    horn = 2e-5
    loose_horn = 2e-4
    plate_mass = 0.0265
    tail_mass = 0.027
    hull_fluid = (1.14, 0.44, 4.91, 1.0, 1.0)
    fin_fluid = (0.95, 0.03, 1.0, 7.37, 0.86)
    stiffness = 0.0126
    bend_damping = 8e-4
    play_damping = 5e-4
    ripples = (1.3, 0.0042)
    servo_gain = 3.0
    servo_damping = 0.1
    servo_torque = 1.5
    setting_s = 0.1
    water = 1000.0
    eddies = (0.02, 0.03, 0.4)

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.factor = fabricate("mur/rigid_body", self.vehicles, self.spreads)

    def describe(self, vehicle: int) -> str:
        """Describe pool, hull and fin."""
        of = {name: float(factor[vehicle]) for name, factor in self.factor.items()}
        x_m_s, y_m_s = np.array(self.carrying_mm_s) / 1000
        arena = self.conditions.robot.arena_mm
        walls = "".join(
            f'<geom type="plane" size="0 0 1" pos="{x / 1000} {y / 1000} 0" zaxis="{inwards} 0" condim="1"/>'
            for x, y, inwards in (
                (arena.x[0], arena.y[0], "1 0"),
                (arena.x[1], arena.y[1], "-1 0"),
                (arena.x[0], arena.y[0], "0 1"),
                (arena.x[1], arena.y[1], "0 -1"),
            )
        )
        inertia = self.inertia * of["mass"]
        drag = (self.hull_fluid[0] * of["drag"], *self.hull_fluid[1:])
        forces = "".join(f'<motor joint="{joint}"/>' for joint in ("x", "y", "yaw"))
        resistances = "".join(
            f'<general joint="{joint}" gaintype="affine" gainprm="0 0 -1"/>' for joint in ("x", "y", "yaw")
        )
        return f"""
        <mujoco>
          <compiler angle="radian"/>
          <option timestep="{self.time_step_s}" integrator="implicit" gravity="0 0 0" density="{self.water}"
                  viscosity="0.0009" wind="{x_m_s} {y_m_s} 0"/>
          <worldbody>
            {walls}
            <body>
              <joint name="x" type="slide" axis="1 0 0"/>
              <joint name="y" type="slide" axis="0 1 0"/>
              <joint name="yaw" axis="0 0 1"/>
              <inertial pos="0 0 0" mass="{self.mass * of["mass"]}" diaginertia="{inertia} {inertia} {inertia}"/>
              <geom type="ellipsoid" size="{_numbers(self.hull)}" fluidshape="ellipsoid" fluidcoef="{_numbers(drag)}"/>
              {self._describe_fin(of)}
            </body>
          </worldbody>
          <actuator>
            <position joint="servo" kp="{self.servo_gain}" kv="{self.servo_damping}"
                      forcerange="-{self.servo_torque} {self.servo_torque}"/>
            {forces}{resistances}
          </actuator>
        </mujoco>"""

    def _describe_fin(self, of: Mapping[str, float]) -> str:
        """Describe the servo's horn, the play behind it if there is any, and both plates."""
        span = of["span"]
        plate = (self.plate[0], self.plate[1], self.plate[2] * span)
        tail = (self.tail[0] * of["chord"], self.tail[1], self.tail[2] * span)
        fluid = f'fluidshape="ellipsoid" fluidcoef="{_numbers(self.fin_fluid)}" contype="0" conaffinity="0"'
        play = ""
        if self.conditions.backlash:
            half_rad = self.conditions.backlash / 2
            play = (
                f'<joint axis="0 0 1" limited="true" range="{-half_rad} {half_rad}" solreflimit="0.012 1" '
                f'solimplimit="0.999 0.9999 0.001" damping="{self.play_damping}"/>'
            )
        return f"""
        <body pos="{-self.hull[0]} 0 0">
          <joint name="servo" axis="0 0 -1" armature="{self.loose_horn if play else self.horn}"/>
          <inertial pos="0 0 0" mass="0.001" diaginertia="1e-7 1e-7 1e-7"/>
          <body>
            {play}
            <geom type="ellipsoid" pos="{-plate[0]} 0 0" size="{_numbers(plate)}" mass="{self.plate_mass}" {fluid}/>
            <body pos="{-2 * plate[0]} 0 0">
              <joint axis="0 0 1" stiffness="{self.stiffness * of["stiffness"]}" damping="{self.bend_damping}"/>
              <geom type="ellipsoid" pos="{-tail[0]} 0 0" size="{_numbers(tail)}" mass="{self.tail_mass}" {fluid}/>
            </body>
          </body>
        </body>"""

    def put(self, pose: np.ndarray) -> np.ndarray:
        """Put them into the water, fins straight."""
        self._setting = np.empty((3, *pose.shape[:2]))
        self._phase_rad = np.empty(pose.shape[:2])
        return super().put(pose)

    def put_back(self, runs: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put them back likewise."""
        self._setting[:, runs] = np.reshape((0.0, 0.0, self.resting_command[2]), (3, 1, 1))
        self._phase_rad[runs] = 0.0
        return super().put_back(runs, pose)

    @property
    def _trim_rad(self) -> np.ndarray:
        """Angle of each fin that is told to be straight, rad, (V,)."""
        trim_rad: np.ndarray = self.factor["trim"] - 1.0 + self.conditions.trim_rad
        return trim_rad

    def resting_control(self, control: np.ndarray) -> np.ndarray:
        """Hold the fins straight: a servo that is switched on with the fin elsewhere throws it there."""
        resting = control.copy()
        resting[:, 0] = self._trim_rad
        return resting

    def at_pose(self, pose: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Shift and turn the hull; the fin keeps its angles."""
        return np.concatenate([pose[..., :2] / 1000, pose[..., 2:], position[..., 3:]], axis=-1)

    def pose(self, position: np.ndarray) -> np.ndarray:
        """Take the hull's own joints."""
        return np.stack([position[..., 0] * 1000, position[..., 1] * 1000, position[..., 2]])

    def target(self, command: np.ndarray, strength: Any) -> np.ndarray:
        """Return the mean angle (rad), the amplitude (rad) and the frequency (rad/s) that are asked for."""
        return np.stack([np.deg2rad(command[0]), np.deg2rad(command[1]) * strength, command[2]])

    def controls(self, target: np.ndarray, moment: Moment) -> np.ndarray:
        """Return the servo's angle (rad), the eddies' forces (N, N, N·m), and the resistances to the hull."""
        steps = target.shape[1]
        resistance = self._resistance(moment)
        stream_m_s = np.array([*self.carrying_mm_s, 0.0]).reshape(3, 1, 1) / 1000
        forces = np.concatenate([self._eddies(moment) + resistance * stream_m_s, resistance])
        control = np.empty((*target.shape[2:], steps, 1 + len(forces)))
        control[..., 1:] = np.moveaxis(forces, 0, -1)[..., None, :]
        step_s = moment.piece_s / steps
        settling = 1.0 - np.exp(-step_s / (self.setting_s + self.conditions.lag_s))
        trim_rad = self._trim_rad
        for step in range(steps):
            self._setting = self._setting + (target[:, step] - self._setting) * settling
            mean_rad, amplitude_rad, frequency_rad_s = self._setting
            self._phase_rad = self._phase_rad + frequency_rad_s * step_s
            control[..., step, 0] = mean_rad + amplitude_rad * np.sin(self._phase_rad) + trim_rad
        return control

    def _eddies(self, moment: Moment) -> np.ndarray:
        """Return random forces (3, R, V) along x and y of the arena and about the upright axis."""
        size = np.array(self.eddies).reshape(3, 1, 1) * self.conditions.noise_factor / np.sqrt(moment.piece_s)
        size = size * np.array([self.mass, self.mass, self.inertia]).reshape(3, 1, 1)
        push = size * moment.noise
        turned = rotate(np.moveaxis(push[:2], 0, -1), moment.pose[2])
        return np.stack([turned[..., 0], turned[..., 1], push[2]])

    def _resistance(self, moment: Moment) -> np.ndarray:
        """Return resistances (3, R, V), N·s/m, N·s/m and N·m·s/rad: waves at the surface, and what weeds add to drag.

        Waves resist in proportion to the speed, the engine's water by its square: each grows so far that a steady
        speed falls by the weeds' share.
        """
        x_mm, y_mm, heading_rad = moment.pose
        none = np.empty((0, *x_mm.shape))
        place = Placement(moment.period.progress, x_mm, y_mm, heading_rad, none, none)
        traction = np.broadcast_to(self.conditions.traction(place), x_mm.shape)
        speed_m_s = np.linalg.norm(moment.velocity[..., :2] - np.array(self.carrying_mm_s) / 1000, axis=-1)
        turn_rad_s = np.abs(moment.velocity[..., 2])
        of_speed, of_turning = self._hull_drag()
        more = traction**-2.0 - 1.0
        moving, turning = (ripple / traction for ripple in self.ripples)
        resistance = moving + of_speed * speed_m_s * more
        return np.stack([resistance, resistance, turning + of_turning * turn_rad_s * more])

    def _hull_drag(self) -> tuple[float, float]:
        """Return by what the engine multiplies the square of the hull's speed ahead (kg/m) and of its turning (kg·m²).

        Of an ellipsoid, blunt and slender drag by the area across the flow and along it (MuJoCo's documentation,
        "Ellipsoid model"); angular likewise by moments of area.
        """
        along, across, upright = self.hull
        blunt, slender, angular, *_ = self.hull_fluid
        front, largest = np.pi * across * upright, np.pi * along * across
        of_turning, most = (8 / 15 * np.pi * width * along**4 for width in (upright, across))
        speed = self.water * (blunt * front + slender * (largest - front))
        turning = self.water * (angular * of_turning + slender * (most - of_turning))
        return float(speed), float(turning)


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(str(value) for value in values)
