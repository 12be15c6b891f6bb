"""What is true of one robot: the interface's numbers, within a workshop's tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import yaml

HERE = Path(__file__).parent


def load_numbers() -> dict:
    """Everything that stands in ``numbers.yaml``."""
    return yaml.safe_load((HERE / 'numbers.yaml').read_text())


@dataclass
class Robot:
    """
    The true robot; arrays may be changed by a hidden effect.

    Attributes:
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
        numbers: the whole file, for what no effect changes.

    """

    mass: float
    inertia: np.ndarray
    centre: np.ndarray
    positions: np.ndarray
    arms: np.ndarray
    spin: np.ndarray
    ratio: float
    thrust_scale: np.ndarray
    time_constant: np.ndarray
    thrust_max: float
    kp: np.ndarray
    kd: np.ndarray
    velocity_limit: np.ndarray
    effort_limit: np.ndarray
    position_limit: float
    joint_inertia: float
    numbers: dict

    @classmethod
    def nominal(cls, numbers: dict | None = None) -> Robot:
        """As the interface describes it."""
        numbers = numbers or load_numbers()
        r = numbers['robot']
        return cls(
            mass=r['mass'], inertia=np.array(r['inertia']), centre=np.zeros(3),
            positions=np.array(r['rotor_positions']),
            arms=np.array([[cos(radians(a)), sin(radians(a))] for a in r['arm_yaw_deg']]),
            spin=np.array(r['spin'], float), ratio=r['torque_to_thrust_ratio'],
            thrust_scale=np.ones(4), time_constant=np.full(4, r['rotor_time_constant']),
            thrust_max=r['thrust_max'], kp=np.full(4, r['kp']), kd=np.full(4, r['kd']),
            velocity_limit=np.full(4, r['velocity_limit']),
            effort_limit=np.full(4, r['effort_limit']), position_limit=r['position_limit'],
            joint_inertia=r['joint_inertia'], numbers=numbers)

    @property
    def hover_thrust(self) -> float:
        """Thrust of one rotor [N] in level hover of the described robot."""
        r = self.numbers['robot']
        return r['mass'] * r['gravity'] / 4

    def within_tolerance(self, rng: np.random.Generator) -> Robot:
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
        return self
