"""The catalogue as candidates of a fit: which numbers are free, in which form, from where."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.keys import Key, SHAPES
from beetle_omni_ros.identify.gap.residual import FlightModel
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.servo import NUMPY, Servo

# Without a slope at their neutral value: they need a start where they already act.
LIMITS = ('thrust_saturation', 'joint_velocity_limit', 'joint_torque_limit', 'joint_friction',
          'joint_backlash')
FORMS = {'tilt_thrust_loss': [{'tilt_thrust_loss.cosine_share': 0.0},
                              {'tilt_thrust_loss.cosine_share': 1.0}],
         'ground_effect': [{'ground_effect.exponential_share': 0.0},
                           {'ground_effect.exponential_share': 1.0}],
         'propeller_gyroscopic_torque': [{'propeller_gyroscopic_torque.spin_up_share': 0.0},
                                         {'propeller_gyroscopic_torque.spin_up_share': -1.0},
                                         {'propeller_gyroscopic_torque.joint_share': 1.0}]}


@dataclass(frozen=True)
class Candidate:
    """
    One way in which a catalogue entry may be true.

    Attributes:
        name: of the entry.
        keys: that are free.
        fixed: form of the entry, as deviations.
        starts: deviations from which to start, each complete for ``keys``; () is zero.
        label: unique.
        member: number of the rotor or joint, or None.

    """

    name: str
    keys: tuple[str, ...]
    fixed: dict[str, float] = field(default_factory=dict)
    starts: tuple[tuple[float, ...], ...] = ()
    label: str = ''
    member: int | None = None

    def pushes(self, keys: dict[str, Key]) -> bool:
        """Whether it shows in nothing but the forces on the body, as gusts do."""
        return all(keys[name].groups == 'B' for name in self.keys)

    def large_enough(self, keys: dict[str, Key], theta: dict[str, float]) -> bool:
        """Whether anyone would act on it."""
        if self.name in ('joint_velocity_limit', 'joint_torque_limit', 'thrust_saturation'):
            return True
        return any(abs(theta.get(name, 0.0)) >= keys[name].smallest for name in self.keys)


def candidates(keys: dict[str, Key], models: list[FlightModel]) -> list[Candidate]:
    """All candidates, with starts that these flights suggest."""
    made = []
    for name, effect in CATALOGUE.items():
        own = tuple(key.name for key in keys.values() if key.effect == name
                    and key.parameter not in SHAPES)
        if not own:
            continue
        if effect.each:
            made += [Candidate(name, (key,), label=f'{name}[{k + 1}]', member=k + 1)
                     for k, key in enumerate(own)]
        elif name == 'module_reaction':
            made += [Candidate(name, own[:1], label=f'{name} (inertia)'),
                     Candidate(name, own, label=name)]
        elif name == 'joint_bandwidth':
            made.append(Candidate(name, own, label=name))
        else:
            starts = _starts(name, keys, models) if name in LIMITS else ()
            if name in LIMITS and not starts:
                continue
            made += [Candidate(name, own, form, starts, name + (f' ({k + 1})' if k else ''))
                     for k, form in enumerate(FORMS.get(name, [{}]))]
    return made


def _starts(name, keys, models):
    """Values at which a limit, friction or play begins to show."""
    if name == 'joint_backlash':
        return ((0.005,), (0.02,))
    if name == 'joint_friction':
        return ((0.004, 0.004), (0.012, 0.015))
    if name == 'joint_velocity_limit':
        met = max(np.abs(m.signals.joints({})[1]).max() for m in models)
        base = keys['joint_velocity_limit.velocity_limit'].base
        return tuple((float(np.log(part * met / base)),) for part in (0.95, 0.8)
                     if part * met < 0.95 * base)
    if name == 'joint_torque_limit':
        asked = max(np.quantile(np.abs(_torques(m)), 0.999) for m in models)
        base = keys['joint_torque_limit.effort_limit'].base
        return tuple((float(np.log(part * asked / base)),) for part in (1.1, 0.8, 0.5)
                     if part * asked < 0.98 * base)
    asked = max(np.quantile(m.flight.command[:, 4:], 0.999) for m in models)
    base = keys['thrust_saturation.thrust_max'].base
    return tuple((float(np.log(part * asked / base)),) for part in (0.95, 0.8)
                 if part * asked < 1.2 * base)


def _torques(model):
    """
    Torques [N m] that the servos' loops ask for, free of limits and of the encoders' noise.

    Not the stiffness times the error alone: while a servo turns, most of that is for the damping.
    """
    s, joint = model.signals, model.robot.joints
    run = model._servos([{}], {})[0]
    rate = np.gradient(run, model.p.grid, axis=1)
    times = s.t[model._starts][:, None] + model.p.grid * np.arange(run.shape[1])
    edges = np.append(times.ravel(), times[-1, -1] + model.p.grid)
    target = s.tilt_targets(edges, s.delays({})[0]).reshape(run.shape)
    return Servo.of(joint, effort_limit=None).motor(NUMPY, target - run, rate)
