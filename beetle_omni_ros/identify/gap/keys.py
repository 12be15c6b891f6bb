"""
The numbers of a fit: every scalar of every catalogue entry, and what else robots differ by.

A fit works with deviations from what the robot file says: differences, or logarithms of ratios
for masses, gains and the like: mass, inertia and thrust scale together without a trace in motion,
and in logarithms that is a straight line. A key is 'effect.parameter' or
'effect.parameter[index]'.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters

GYROSCOPIC, MODULES = 'propeller_gyroscopic_torque', 'module_reaction'
SHAPES = ('cosine_share', 'exponential_share', 'spin_up_share', 'joint_share')
SMALLEST = 0.02         # ratio to the file's own number ...
# ... but of a limit so far above all that is asked for that a real one is hundreds of times less:
# the file's 3 N m against the 0.05 N m of quick poses.
SMALLEST_OF = {'effort_limit': 1e-3}
TILT_BUS, THRUST_BUS = 'base.tilt_delay', 'base.thrust_delay'   # of commands on their way
GROUPS = {  # signal-layer entries -> channel groups in which they show
    'rotor_lag': 'B', 'rotor_dead_time': 'B', 'thrust_saturation': 'B', 'command_latency': 'BJ',
    'joint_command_latency': 'J', 'joint_bandwidth': 'J', 'joint_velocity_limit': 'J',
    'joint_torque_limit': 'J', 'joint_friction': 'J', 'joint_deflection': 'J',
    'joint_backlash': 'B', 'joint_feedback_delay': 'BJ', 'mocap_time_offset': 'AW',
    'imu_filter_lag': 'BAWJ', 'imu_accelerometer_bias': 'BA', 'imu_gyroscope_bias': 'BW',
    'imu_misalignment': 'BAW', 'imu_lever_arm': 'BA', 'mocap_misalignment': 'AW',
    'base': 'BJ', 'modules': 'BJ', 'swing': 'J', 'rotor': 'B', 'servo': 'J'}


@dataclass(frozen=True)
class Key:
    """
    One scalar of a fit.

    Attributes:
        name: 'effect.parameter[index]'.
        effect: catalogue name.
        parameter: its name there.
        index: within a vector, or None.
        base: value that the robot file has.
        relative: whether a deviation is the logarithm of a ratio to ``base``.
        low: smallest deviation.
        high: largest.
        typical: realistic deviation.
        smallest: worth naming.
        body: whether the body's equations hold it, else a signal does.
        turns: whether it also loads the joints.

    """

    name: str
    effect: str
    parameter: str
    index: int | None
    base: float
    relative: bool
    low: float
    high: float
    typical: float
    smallest: float
    body: bool
    turns: bool = False

    def value(self, deviation: float) -> float:
        """Catalogue value of a deviation."""
        return self.base * math.exp(deviation) if self.relative else self.base + deviation

    def width(self, deviation: float, half: float) -> float:
        """Half width in the catalogue's unit of one in deviations."""
        return half * abs(self.value(deviation)) if self.relative else half

    @property
    def ends_at_none(self) -> bool:
        """Whether the smallest value is an effect that is not there, as of drag or friction."""
        return not self.relative and self.value(self.low) == 0.0

    @property
    def groups(self) -> str:
        """Channel groups that depend on it."""
        if self.body:
            return 'BJ' if self.turns else 'B'
        return GROUPS[self.effect]


def _own(robot: RobotParameters) -> dict[str, float | np.ndarray]:
    joints, rotors = robot.joints, robot.rotors
    return {'mass': robot.mass, 'inertia': robot.inertia,
            'torque_to_thrust_ratio': rotors.torque_to_thrust_ratio,
            'time_constant': rotors.time_constant, 'thrust_max': rotors.thrust_max,
            'kp': joints.kp, 'kd': joints.kd, 'velocity_limit': joints.velocity_limit,
            'effort_limit': joints.effort_limit}


def friction(robot: RobotParameters) -> tuple[np.ndarray, np.ndarray]:
    """Coulomb friction and stiction of the file [N m], the latter at least the former; (4,)."""
    own = robot.effects.get('joint_friction', {'coulomb': 0.0, 'stiction': 0.0})
    coulomb, stiction = (np.broadcast_to(own[name], 4) for name in ('coulomb', 'stiction'))
    return coulomb, np.maximum(stiction, coulomb)


def all_keys(robot: RobotParameters) -> dict[str, Key]:
    """Every scalar of the catalogue around what ``robot`` has, by name."""
    own, keys = _own(robot), {}
    effects = dict(robot.effects)
    if 'joint_friction' in effects:
        # a flight judges what all joints share; differences between them stay as the file has them
        effects['joint_friction'] = dict(zip(('coulomb', 'stiction'), (
            float(np.mean(value)) for value in friction(robot))))
    # described modules load the joints with their share, and this entry is what goes beyond
    turning = {GYROSCOPIC} if robot.multibody else {GYROSCOPIC, MODULES}
    for name, effect in CATALOGUE.items():
        for parameter, spec in effect.parameters.items():
            neutral = np.atleast_1d(np.array(spec.neutral, dtype=float))
            absent = bool(np.isnan(neutral).any())
            relative = absent or parameter == 'scale'
            base = np.atleast_1d(np.array(effects.get(name, {}).get(
                parameter, own.get(parameter) if absent else spec.neutral), dtype=float))
            scalar = np.ndim(spec.neutral) == 0
            for k, value in enumerate(base):
                least = SMALLEST_OF.get(parameter, SMALLEST)
                low, high = (math.log(max(b / value, least)) if relative else b - value
                             for b in (spec.low, spec.high))
                text = f'{name}.{parameter}' + ('' if scalar else f'[{k}]')
                keys[text] = Key(text, name, parameter, None if scalar else k, float(value),
                                 relative, low, high,
                                 0.5 if math.isnan(spec.typical) else spec.typical,
                                 0.0 if math.isnan(spec.smallest) else spec.smallest,
                                 effect.apply is not None, name in turning)
    return keys


@dataclass(frozen=True)
class Belief:
    """
    What is believed of a key beside the data: zero, within ``deviation``.

    Within -below to above of zero nothing is said but ``inner``, a very wide deviation.
    """

    deviation: float
    below: float = 0.0
    above: float = 0.0
    inner: float = math.inf

    def residual(self, x: float) -> float:
        """How many standard deviations ``x`` lies off, and within the free range little."""
        out = max(x - self.above, 0.0) + min(x + self.below, 0.0)
        return out / self.deviation + x / self.inner

    def within(self, x: float, deviations: float) -> float:
        """``x``, or the nearest value that is no more than so many deviations off."""
        reach = deviations * self.deviation
        return min(max(x, -self.below - reach), self.above + reach)

    def slope(self, x: float) -> float:
        """Derivative of :meth:`residual`."""
        return (0.0 if -self.below < x < self.above else 1 / self.deviation) + 1 / self.inner


def tolerances(p: GapParameters, coarse: bool = False,
               swing: float = 0.0) -> dict[str, Belief]:
    """
    Keys that every robot differs by, with the belief that it is by little.

    Args:
        p: parameters.
        coarse: whether the sensors are of the kind whose stamps hide their latency.
        swing: logarithm by which a servo's inertia may be larger than it says.

    """
    made = {'mass.mass': p.tolerance_mass, 'thrust_coefficient.scale': p.tolerance_thrust,
            'torque_coefficient.torque_to_thrust_ratio': p.tolerance_torque_ratio,
            'rotor_lag.time_constant': p.tolerance_lag, 'joint_bandwidth.kp': p.tolerance_lag,
            'joint_bandwidth.kd': p.tolerance_lag, 'mocap_time_offset.delay': p.tolerance_delay,
            'imu_filter_lag.delay': p.tolerance_delay,
            'joint_feedback_delay.delay': p.tolerance_delay, 'modules.share': p.modules_tolerance}
    for k in range(3):
        made |= {f'inertia.inertia[{k}]': p.tolerance_inertia,
                 f'imu_accelerometer_bias.bias[{k}]': p.tolerance_bias_accelerometer,
                 f'imu_gyroscope_bias.bias[{k}]': p.tolerance_bias_gyroscope,
                 f'imu_misalignment.rotation[{k}]': p.tolerance_angle,
                 f'mocap_misalignment.rotation[{k}]': p.tolerance_angle}
    for k in range(4):
        made |= {f'rotor_thrust_coefficient.scale[{k}]': p.tolerance_thrust,
                 f'joint_offset.offset[{k}]': p.tolerance_angle,
                 f'rotor.lag[{k}]': p.tolerance_lag, f'servo.kp[{k}]': p.tolerance_lag,
                 f'servo.kd[{k}]': p.tolerance_lag}
    for k in range(12):
        made[f'position.offset[{k}]'] = p.tolerance_position
    beliefs = {name: Belief(deviation) for name, deviation in made.items()}
    beliefs['imu_filter_lag.delay'] = Belief(p.tolerance_delay, 0.0, p.imu_averaging, 0.002)
    reach, nominal = p.command_delay_range, p.command_delay
    for bus in (TILT_BUS, THRUST_BUS):
        beliefs[bus] = Belief(5e-4, nominal, reach / 2, p.bus_near[0])
    near = p.tolerance_swing
    beliefs['swing.ratio'] = Belief(p.tolerance_lag, near, max(swing, near), swing + near)
    if coarse:
        imu, joint = p.coarse_latency
        beliefs['imu_filter_lag.delay'] = Belief(p.tolerance_delay, 0.0, imu, imu)
        beliefs['joint_feedback_delay.delay'] = Belief(p.tolerance_delay, 0.0, joint, joint)
        for bus in (TILT_BUS, THRUST_BUS):
            beliefs[bus] = Belief(5e-4, nominal, reach / 2, p.bus_near[1])
    return beliefs


def extra_keys() -> dict[str, Key]:
    """Keys of what is no catalogue entry: rotor positions, modules, servos, delays of the bus."""
    keys = {}
    for k in range(12):
        name = f'position.offset[{k}]'
        keys[name] = Key(name, 'position', 'offset', k, 0.0, False, -0.05, 0.05, 0.001, 0.0, True)
    keys['modules.share'] = Key('modules.share', 'modules', 'share', None, 0.0, False, -2, 2,
                                0.05, 0.0, False)
    keys['swing.ratio'] = Key('swing.ratio', 'swing', 'ratio', None, 0.0, False, -1, 1, 0.1, 0.0,
                              False)
    for k in range(4):
        name = f'rotor.lag[{k}]'
        keys[name] = Key(name, 'rotor', 'lag', k, 0.0, False, -1, 1, 0.1, 0.0, False)
        for gain in ('kp', 'kd'):
            name = f'servo.{gain}[{k}]'
            keys[name] = Key(name, 'servo', gain, k, 0.0, False, -1, 1, 0.3, 0.0, False)
    for name in (TILT_BUS, THRUST_BUS):
        keys[name] = Key(name, 'base', 'delay', None, 0.0, False, -0.05, 0.05, 0.005, 0.0, False)
    return keys
