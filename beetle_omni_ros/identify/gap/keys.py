"""
Fitted scalars: parameters of the catalogue, tolerances of the robot, delays of the bus.

A fit works with deviations from the robot file: differences, or logarithms of ratios for masses,
gains and the like. Mass, inertia and thrust scaled by one factor do not change the motion, and
in logarithms this direction is a straight line. A key is 'effect.parameter' or
'effect.parameter[index]'.
"""

from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.treatment import Size, TREATMENTS
from beetle_omni_ros.model.effects import CATALOGUE, delaying, ignored
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.terms import EffectParameter

MODULES = 'module_reaction'
NO_SIZE = Size(0.5, 0.0)     # of a parameter that only selects a form
# Effects without a slope at their neutral value; they need a start where they act.
LIMITS = tuple(name for name, treatment in TREATMENTS.items() if treatment.starts)
TILT_BUS, THRUST_BUS = 'base.tilt_delay', 'base.thrust_delay'   # delays of commands


@dataclass(frozen=True)
class Key:
    """
    One scalar of a fit.

    Attributes:
        name: 'effect.parameter[index]'.
        effect: catalogue name.
        parameter: its name there.
        index: index in a vector, or None.
        base: value of the robot file.
        relative: whether a deviation is the logarithm of a ratio to ``base``.
        typical: typical deviation.
        smallest: smallest relevant deviation.
        groups: channel groups that depend on it.
        body: whether it is in the body equations, not in a signal.
        step: step of finite differences.
        form: whether it selects a form and is not fitted.
        ends_at_none: whether the smallest value means no effect, as of drag or friction.

    """

    name: str
    effect: str
    parameter: str
    index: int | None
    base: float
    relative: bool
    typical: float
    smallest: float
    groups: str
    body: bool = False
    step: float = 1e-3
    form: bool = False
    ends_at_none: bool = False

    def value(self, deviation: float) -> float:
        """Catalogue value of a deviation."""
        return self.base * math.exp(deviation) if self.relative else self.base + deviation


def number_of(robot: RobotParameters, key: str) -> float | np.ndarray:
    """Value of the robot file at a dotted key."""
    value: Any = robot
    for part in key.split('.'):
        value = getattr(value, part)
    return value


def base_of(spec: EffectParameter, value) -> np.ndarray:
    """
    Base values (n,) of the keys of a parameter.

    A flight fits the mean of the joints; differences between joints stay as in the file.
    """
    return np.atleast_1d(np.mean(value) if spec.of_each else np.array(value, dtype=float))


def names_of(effect: str, parameter: str) -> list[str]:
    """Key names of a parameter."""
    neutral, text = CATALOGUE[effect].parameters[parameter].neutral, f'{effect}.{parameter}'
    return [f'{text}[{k}]' for k in range(len(neutral))] if isinstance(neutral, tuple) else [text]


def delays_of(*what: str) -> tuple[str, ...]:
    """Key names of delays of any of ``what``; see :attr:`Effect.delays`."""
    return tuple(f'{name}.delay' for name in delaying(*what))


def friction(robot: RobotParameters) -> tuple[np.ndarray, np.ndarray]:
    """Coulomb friction and stiction of the file [N m], (4,) each; stiction is the larger one."""
    own = robot.effects.get('joint_friction', {'coulomb': 0.0, 'stiction': 0.0})
    coulomb, stiction = (np.broadcast_to(own[name], 4) for name in ('coulomb', 'stiction'))
    return coulomb, np.maximum(stiction, coulomb)


def all_keys(robot: RobotParameters) -> dict[str, Key]:
    """Keys of the whole catalogue with base values of ``robot``, by name."""
    keys, effects = {}, dict(robot.effects)
    if 'joint_friction' in effects:
        effects['joint_friction'] = dict(zip(CATALOGUE['joint_friction'].parameters,
                                             friction(robot), strict=True))
    for name, effect in CATALOGUE.items():
        if name not in TREATMENTS or ignored('gap', name):
            continue
        treatment = TREATMENTS[name]
        # The file's modules load the joints by their share, so this entry is only the excess.
        groups = 'B' if name == MODULES and robot.multibody else treatment.channels
        for parameter, spec in effect.parameters.items():
            absent = bool(np.isnan(spec.neutral).any())
            relative = absent or parameter == 'scale'
            own = number_of(robot, spec.number) if absent else spec.neutral
            size = treatment.sizes.get(parameter, NO_SIZE)
            base = base_of(spec, effects.get(name, {}).get(parameter, own))
            texts = names_of(name, parameter)
            for k, (text, value) in enumerate(zip(texts, base, strict=True)):
                keys[text] = Key(text, name, parameter, k if len(texts) > 1 else None,
                                 float(value), relative, size.typical, size.smallest, groups,
                                 effect.apply is not None, size.step, spec.form,
                                 not relative and spec.low == 0.0)
    return keys


def tolerances(p: GapParameters) -> dict[str, float]:
    """Prior deviations of the keys by which every robot differs from the robot file."""
    result = {key: getattr(p, f'tolerance_{size.tolerance}')
              for name, treatment in TREATMENTS.items()
              for parameter, size in treatment.sizes.items() if size.tolerance
              for key in names_of(name, parameter)}
    result['modules.share'] = p.modules_tolerance
    for k in range(4):
        result |= {f'rotor.lag[{k}]': p.tolerance_lag, f'servo.kp[{k}]': p.tolerance_lag,
                   f'servo.kd[{k}]': p.tolerance_lag}
    for k in range(12):
        result[f'position.offset[{k}]'] = p.tolerance_position
    return result


def extra_keys() -> dict[str, Key]:
    """Keys outside the catalogue: rotor positions, modules, servos, delays of the bus."""
    keys = {}

    def add(name, index, typical, groups, **more):
        effect, parameter = name.split('[')[0].split('.')
        keys[name] = Key(name, effect, more.pop('parameter', parameter), index, 0.0, False,
                         typical, 0.0, groups, **more)

    for k in range(12):
        add(f'position.offset[{k}]', k, 0.001, 'B', body=True)
    add('modules.share', None, 0.05, 'BJ', step=0.05)
    add('swing.ratio', None, 0.1, 'J', step=0.01)
    for k in range(4):
        add(f'rotor.lag[{k}]', k, 0.1, 'B', step=0.02)
        for gain in ('kp', 'kd'):
            add(f'servo.{gain}[{k}]', k, 0.3, 'J', step=0.01)
    for name in (TILT_BUS, THRUST_BUS):
        add(name, None, 0.005, 'BJ', parameter='delay')
    return keys
