"""
Tilt servos simulated from commands, for many windows and parameter sets at once.

The step is that of :mod:`beetle_omni_ros.model.servo` with static friction, unlike the smooth
model of the controllers. Each window begins at the measured state. The memory of a servo is far
shorter than the warm-up, after which samples count.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.flights.keys import DROOP, friction, Key, MODULES, OF_ONE
from beetle_omni_ros.identify.flights.signals import Signals
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.identify.recording.bag import COMMAND
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import NUMPY, Servo, Step
from beetle_omni_ros.model.terms import ServoTerms


@dataclass(frozen=True)
class Windows:
    """
    Inputs of a flight's joints, cut into windows.

    Attributes:
        start: (W, 4) measured positions at the beginning of the windows [rad].
        start_rate: (W, 4) measured rates there [rad/s].
        thrust: (K, W, 4) thrust of each joint's rotor at each step [N].
        load: (K, W, 4) torque of motion and gravity on the joint, for share 1 [N m].
        step: period of the simulation [s].
        skip: steps of warm-up.
        every: steps between samples.
        undescribed: (K, W, 4) torques of modules that are not in the robot file, for each kg m of
            mass moment and each kg m^2 of inertia, or nothing.

    """

    start: np.ndarray
    start_rate: np.ndarray
    thrust: np.ndarray
    load: np.ndarray
    step: float
    skip: int
    every: int
    undescribed: tuple[np.ndarray, ...] = ()


def windows_of(signals: Signals, starts: np.ndarray, theta: dict[str, float]
               ) -> tuple[Windows, np.ndarray]:
    """
    Windows that begin to count at ``starts`` (W,) of the grid, with timing and loads at ``theta``.

    Returns:
        the windows, and the times (W, K + 1) of the edges of their steps [s].

    """
    s, p = signals, signals.p
    skip, count = round(p.servo_warm_up / p.servo_step), round(p.servo_window / p.servo_step)
    edges = (s.t[starts] - skip * p.servo_step)[:, None] \
        + p.servo_step * np.arange(skip + count + 1)
    tilt, rate, _, _ = s.joints(theta)
    at = starts - round(p.servo_warm_up / p.grid)
    middle = edges[:, :-1] + p.servo_step / 2
    index = np.clip(np.rint((middle - s.t[0]) / p.grid).astype(int), 0, len(s.t) - 1)
    loads = (s.thrust({})[0], module_load(s, theta), *undescribed_load(s, theta))
    force, load, *more = (series[index].transpose(1, 0, 2) for series in loads)
    return Windows(tilt[at], rate[at], force, load, p.servo_step, skip,
                   round(p.grid / p.servo_step), tuple(more)), edges


def simulate(robot: RobotParameters, windows: Windows, targets: np.ndarray, which: np.ndarray,
             sets: list[dict[str, float]], modules: float) -> np.ndarray:
    """
    Free runs of the servos.

    Args:
        robot: parameters of the robot file with its effects.
        windows: windows of one flight.
        targets: (D, K, W, 4) different commands [rad].
        which: (P,) index of the commands of each set.
        sets: P sets of deviations by key name.
        modules: share of the file's tilting modules.

    Returns:
        (P, M, W, 4) positions after the warm-up [rad].

    """
    def column(name, result=lambda x: x):
        return np.array([result(values.get(name, 0.0)) for values in sets])[:, None, None]

    def each(name):
        return np.concatenate([column(f'{name}[{k}]') for k in range(4)], axis=2)

    numbers, acting = _of_effects(robot, column, each)
    joint, hanging = robot.joints, robot.effects.get(MODULES, {})
    kp = joint.kp * numbers['kp'] * np.exp(each('servo.kp'))
    kd = joint.kd * numbers['kd'] * np.exp(each('servo.kd'))
    speed = joint.velocity_limit * numbers['velocity_limit']
    effort = joint.effort_limit * numbers['effort_limit']
    loads = _loads(windows, hanging, modules, column)

    def terms_at(k):
        result = ServoTerms(targets[which, k], windows.thrust[k])
        for act, values in acting:
            act(result, None, **values)
        for torque, size in loads:
            result.load = result.load + size * torque[k]
        return result

    # The torque limit is skipped if the largest error cannot reach it.
    reach = kp * np.abs(targets - windows.start).max() * 1.5 + kd * speed
    first = terms_at(0)
    step = Step(NUMPY, Servo(
        joint.inertia * column('swing.ratio', np.exp), kp, kd, speed,
        effort if (effort < reach).any() else None, coulomb=first.coulomb,
        stiction=first.stiction,
        speed_gradient=joint.speed_gradient * column(DROOP, np.exp)), windows.step)
    q = np.broadcast_to(windows.start, (len(sets), *windows.start.shape)).copy()
    v = np.broadcast_to(windows.start_rate, q.shape).copy()
    shown = np.empty(((targets.shape[1] - windows.skip) // windows.every, *q.shape))
    for k in range(targets.shape[1]):
        if k >= windows.skip and (k - windows.skip) % windows.every == 0:
            index = (k - windows.skip) // windows.every
            if index < len(shown):
                shown[index] = q
        terms = terms_at(k)
        q, v = step(terms.target, q, v, None if np.isscalar(terms.load) else terms.load)
    return shown.transpose(1, 0, 2, 3)


def _of_effects(robot, column, each):
    """
    Servo parameters that the catalogue changes.

    Returns:
        (name of a joint parameter -> factors), and (servo equation, parameters) of each active
        effect.

    """
    own = {'joint_friction': dict(zip(('coulomb', 'stiction'), friction(robot), strict=True))}
    numbers: dict[str, np.ndarray] = {}
    acting = []
    for name, effect in CATALOGUE.items():
        numbers |= {key.partition('.')[2]: column(f'{name}.{parameter}', np.exp)
                    for parameter, key in effect.settings.items() if key.startswith('joints.')}
        if effect.servo is None:
            continue
        base = {**robot.effects, **own}.get(name, {})
        # a servo equation is unstable outside the physical range
        values = {p: np.maximum(np.asarray(base.get(p, spec.neutral)) + column(f'{name}.{p}')
                                + (each(f'servo.{p}') if p in OF_ONE else 0.0),
                                spec.low) for p, spec in effect.parameters.items()}
        if any(values[p].any() for p in effect.numbers):
            acting.append((effect.servo, values))
    return numbers, acting


def _loads(windows, hanging, modules, column):
    """(unit torque, size) of each load of the modules on the joints."""
    loads = [(windows.load, modules + column('modules.share'))]
    loads += [(torque, hanging.get(name, 0.0) + column(f'{MODULES}.{name}')) for torque, name in
              zip(windows.undescribed, ('mass_moment', 'module_inertia'), strict=False)]
    return [(torque, size) for torque, size in loads if size.any()]


def module_load(signals: Signals, theta: dict[str, float]) -> np.ndarray:
    """Torque of gravity and motion on each joint by the file's modules (N, 4) [N m]."""
    robot, tilt = signals.robot, signals.joints(theta)[0]
    load = np.zeros_like(tilt)
    parts = robot.multibody
    if parts is None or 'module_reaction' in robot.effects:
        return load
    module, turning = parts.module, signals.imu(theta)[2]
    outward, _, up = module.centre_of_mass
    normals = robot.thrust_directions(tilt)
    for i, axis in enumerate(robot.tilt_axes):
        normal = normals[:, i]
        place = robot.rotors.positions[i] + (outward - module.rotor_offset) * axis + up * normal
        pull = -module.mass * up * np.cross(normal, _felt(signals, theta, place)) @ axis
        load[:, i] = pull - module.inertia[0] * turning @ axis
    return load


def undescribed_load(signals: Signals, theta: dict[str, float]) -> tuple[np.ndarray, ...]:
    """
    Torque on each joint of modules that are not in the robot file.

    Returns:
        (N, 4) for each kg m of mass moment, (N, 4) for each kg m^2 of inertia about the joint
        axis; nothing if the file describes the modules.

    """
    robot, tilt = signals.robot, signals.joints(theta)[0]
    if robot.multibody is not None:
        return ()
    hanging, turning = np.empty_like(tilt), -signals.imu(theta)[2] @ robot.tilt_axes.T
    normals = robot.thrust_directions(tilt)
    for i, axis in enumerate(robot.tilt_axes):
        felt = _felt(signals, theta, robot.rotors.positions[i])
        hanging[:, i] = np.cross(normals[:, i], felt) @ axis
    return hanging, turning


def _felt(signals, theta, place):
    """Specific force (N, 3) at a point of the body, in body axes [m/s^2]."""
    force, rate, turning = signals.imu(theta)
    return force + np.cross(turning, place) + np.cross(rate, np.cross(rate, place))


def starts_of(key: Key, models: Sequence) -> tuple[tuple[float, ...], ...]:
    """
    Starts of an effect without a slope; of a limit, where it begins to act in these flights.

    ``models`` are of :class:`~beetle_omni_ros.identify.flights.bag_flight.BagFlight`.
    """
    treatment = TREATMENTS[key.effect]
    if treatment.limit is None:
        return treatment.starts
    what, below = treatment.limit
    most = max(float({
        'tilt_rate': lambda m: np.abs(m.signals.joints({})[1]).max(),
        'torque': lambda m: np.quantile(np.abs(_torques(m)), 0.999),
        'thrust': lambda m: np.quantile(m.flight.values[COMMAND][:, 4:], 0.999)}[what](m))
        for m in models)
    return tuple((float(np.log(part * most / key.base)),) for part, in treatment.starts
                 if part * most < below * key.base)


def _torques(model):
    """
    Torques [N m] that the simulated servo loops request, without limits and encoder noise.

    They include damping, which takes most of the stiffness term while a servo turns.
    """
    s, joint = model.signals, model.robot.joints
    run = model._servos([{}], {})[0]
    rate = np.gradient(run, model.p.grid, axis=1)
    times = s.t[model._starts][:, None] + model.p.grid * np.arange(run.shape[1])
    edges = np.append(times.ravel(), times[-1, -1] + model.p.grid)
    target = s.tilt_targets(edges, s.delays({})[0]).reshape(run.shape)
    return Servo.of(joint, effort_limit=None).motor(NUMPY, target - run, rate)
