"""
Every hidden effect by name: how it is put into a flight and what its true parameters are.

The names are the interface's catalogue (plus effects that no catalogue holds). The formulas are
the generator's own: for each effect ``plain`` is the textbook form that defines the parameter,
the other shapes differ from it as a real effect would, and agree with it at the point at which
the interface defines the parameter.
"""

from collections.abc import Callable
from inspect import isfunction

import numpy as np

from gap_data import effects_actuators as actuators
from gap_data import effects_body as body
from gap_data import effects_outside as outside
from gap_data import effects_sensors as sensors
from gap_data.hidden import Hidden
from gap_data.truth import Robot

# name -> shapes other than 'plain'
SHAPES: dict[str, tuple[str, ...]] = {
    'ground_effect': ('image', 'decay'), 'rotor_drag': ('flapping',), 'body_drag': ('blunt',),
    'axial_inflow': ('momentum',), 'translational_lift': ('glauert',),
    'tilt_thrust_loss': ('sweep', 'shadow', 'lens'), 'wind': ('breathing',),
    'propeller_gyroscopic_torque': ('full', 'offset'), 'rotor_acceleration_torque': ('offset',),
    'voltage_sag': ('square',), 'rotor_lag': ('second', 'skewed'), 'thrust_saturation': ('soft',),
    'joint_bandwidth': ('damped',), 'joint_friction': ('stribeck',),
    'joint_backlash': ('sprung',), 'joint_deflection': ('hardening',),
    'imu_filter_lag': ('butterworth',)}

Build = Callable[[Robot, Hidden, float, str, np.random.Generator], dict]


def _effects(*modules) -> dict[str, Build]:
    return {name: build for module in modules for name, build in vars(module).items()
            if isfunction(build) and build.__module__ == module.__name__ and name[0] != '_'}


CATALOGUE, OUTSIDE = _effects(body, actuators, sensors), _effects(outside)
# A true effect whose companion is part of the same physics: naming it too is not wrong.
COMPANIONS = {'propeller_gyroscopic_torque': ('rotor_acceleration_torque',),
              'rotor_acceleration_torque': ('propeller_gyroscopic_torque',)}


def inject(name: str, robot: Robot, hidden: Hidden, size: float, shape: str,
           rng: np.random.Generator) -> dict:
    """
    Put one effect into a robot; the same generator state gives the same effect again.

    Args:
        name: in ``CATALOGUE`` or ``OUTSIDE``.
        robot: changed.
        hidden: changed.
        size: in the effect's own unit, signed, see ``campaign.yaml``.
        shape: 'plain' or one of ``SHAPES``.
        rng: for directions and which rotor or joint.

    Returns:
        The true parameters under the interface's names, lists for vectors, and ``rotor`` or
        ``joint`` where it is one of four.

    """
    if shape != 'plain' and shape not in SHAPES.get(name, ()):
        raise ValueError(f"effect '{name}' has no shape '{shape}'")
    build = CATALOGUE.get(name) or OUTSIDE.get(name)
    if build is None:
        raise ValueError(f"no effect '{name}'")
    found = build(robot, hidden, float(size), shape, rng)
    return {key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in found.items()}
