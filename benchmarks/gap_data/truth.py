"""What is true of one robot: the interface's numbers, within a workshop's tolerances."""

from math import cos, radians, sin
from pathlib import Path

import numpy as np
import yaml

NUMBERS = Path(__file__).with_name('numbers.yaml')


class Robot:
    """
    The true robot, at first as the interface describes it; arrays may be changed by an effect.

    Attributes:
        numbers: the whole file, for what no effect changes.
        mass: [kg].
        inertia: (3,) [kg m^2] about the centre of gravity.
        centre: (3,) [m] centre of gravity in base_link, with all tilts at zero.
        positions: (4, 3) [m] rotor centres in base_link.
        arms: (4, 2) outward directions of the arms, x and y.
        spin: (4,) +1 or -1.
        ratio: [m] torque-to-thrust ratio.
        thrust_scale: (4,) [1] real over commanded thrust.
        time_constant: (4,) [s] of the rotors.
        thrust_max: [N] commands are cut there.
        kp, kd: (4,) [N m/rad], [N m s/rad] of the servos.
        velocity_limit, effort_limit, position_limit: of the servos [rad/s], [N m], [rad].
        joint_inertia: [kg m^2].

    """

    def __init__(self):
        self.numbers = yaml.safe_load(NUMBERS.read_text())
        r = self.numbers['robot']
        self.mass, self.inertia, self.centre = r['mass'], np.array(r['inertia']), np.zeros(3)
        self.positions = np.array(r['rotor_positions'])
        self.arms = np.array([[cos(radians(a)), sin(radians(a))] for a in r['arm_yaw_deg']])
        self.spin, self.ratio = np.array(r['spin'], float), r['torque_to_thrust_ratio']
        self.thrust_scale, self.thrust_max = np.ones(4), r['thrust_max']
        self.time_constant = np.full(4, r['rotor_time_constant'])
        self.kp, self.kd = np.full(4, r['kp']), np.full(4, r['kd'])
        self.velocity_limit = np.full(4, r['velocity_limit'])
        self.effort_limit = np.full(4, r['effort_limit'])
        self.position_limit, self.joint_inertia = r['position_limit'], r['joint_inertia']

    @property
    def hover_thrust(self) -> float:
        """Thrust of one rotor [N] in level hover of the described robot."""
        r = self.numbers['robot']
        return r['mass'] * r['gravity'] / 4

    def within_tolerance(self, rng: np.random.Generator) -> None:
        """Draw every parameter within the tolerances, uniformly; changes this robot."""
        tolerance = self.numbers['tolerance']

        def draw(name, size=None):
            return tolerance[name] * rng.uniform(-1.0, 1.0, size)

        self.mass *= 1 + draw('mass')
        self.inertia = self.inertia * (1 + draw('inertia', 3))
        self.thrust_scale = self.thrust_scale * (1 + draw('thrust', 4))
        self.positions = self.positions + draw('rotor_position', (4, 3))
        self.time_constant = self.time_constant * (1 + draw('lag', 4))
        self.kp = self.kp * (1 + draw('lag', 4))
        self.kd = self.kd * (1 + draw('lag', 4))
