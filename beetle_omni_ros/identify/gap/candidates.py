"""The catalogue as candidates of a fit: which numbers are free, in which form, from where."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.fit import State
from beetle_omni_ros.identify.gap.keys import Key, MODULES
from beetle_omni_ros.identify.gap.residual import FlightModel
from beetle_omni_ros.identify.inference.blocks import HeldOut
from beetle_omni_ros.robot.effects import CATALOGUE, LimitStarts
from beetle_omni_ros.robot.servo import NUMPY, Servo

TOO_SMALL = 'too small to matter'
IMPOSSIBLE = 'beyond what is physical'
NOT_HELD = 'does not hold on data left out'
FOUGHT = 'in slow or in quick motion alone, as gusts and answers to them'


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
        if isinstance(CATALOGUE[self.name].starts, LimitStarts):
            return True
        return any(abs(theta.get(name, 0.0)) >= keys[name].smallest for name in self.keys)


def candidates(keys: dict[str, Key], models: list[FlightModel]) -> list[Candidate]:
    """All candidates, with starts that these flights suggest."""
    made = []
    for name, effect in CATALOGUE.items():
        own = tuple(key.name for key in keys.values() if key.effect == name
                    and not key.form)
        if not own:
            continue
        if effect.each:
            made += [Candidate(name, (key,), label=f'{name}[{k + 1}]', member=k + 1)
                     for k, key in enumerate(own)]
        elif name == MODULES:
            made += [Candidate(name, own[:1], label=f'{name} (inertia)'),
                     Candidate(name, own, label=name)]
        else:
            starts = _started(keys[own[0]], effect.starts, models) \
                if isinstance(effect.starts, LimitStarts) else effect.starts
            if effect.starts and not starts:
                continue
            made += [Candidate(name, own, {f'{name}.{part}': x for part, x in form.items()},
                               starts, name + (f' ({k + 1})' if k else ''))
                     for k, form in enumerate(effect.forms)]
    return made


def _started(key, asked, models):
    """Values of a limit at which it begins to show."""
    most = max(float({
        'tilt_rate': lambda m: np.abs(m.signals.joints({})[1]).max(),
        'torque': lambda m: np.quantile(np.abs(_torques(m)), 0.999),
        'thrust': lambda m: np.quantile(m.flight.command[:, 4:], 0.999)}[asked.of](m))
        for m in models)
    return tuple((float(np.log(part * most / key.base)),) for part in asked.parts
                 if part * most < asked.below * key.base)


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


@dataclass
class Trial:
    """
    One candidate joined to the model.

    Attributes:
        candidate: which.
        gain: of the objective.
        theta: all numbers with it.
        refined: whether fitted, else a straight line's estimate.
        believed: part of the gain that is of beliefs: tolerances which stray less beside it.
        held: gains on blocks left out.
        share: of what was left unexplained.
        reason: why not accepted, '' if it was.

    """

    candidate: Candidate
    gain: float
    theta: dict[str, float]
    refined: bool = False
    believed: float = 0.0
    held: HeldOut = HeldOut(np.zeros(1))
    share: float = 0.0
    reason: str = ''


@dataclass
class Found:
    """
    What a search found.

    Attributes:
        accepted: steps, in the order of acceptance.
        trials: label -> last trial of every candidate.
        rivals: label of an accepted candidate -> trials that explain as much.
        base: numbers of the fit without effects.
        theta: of the final fit.
        state: there, with the slopes of all keys.
        cost: objective of base, final, and everything (straight line).
        still: whether the robot hardly moves but where it is pushed; see ``liveliness``.

    """

    accepted: list[Trial] = field(default_factory=list)
    trials: dict[str, Trial] = field(default_factory=dict)
    rivals: dict[str, list[Trial]] = field(default_factory=dict)
    base: dict[str, float] = field(default_factory=dict)
    theta: dict[str, float] = field(default_factory=dict)
    state: State = field(
        default_factory=lambda: State({}, np.zeros(0), np.zeros((0, 0)), []))
    cost: tuple[float, float, float] = (0.0, 0.0, 0.0)
    still: bool = False

    @property
    def explained(self) -> float:
        """Part of the explainable excess that the accepted entries explain."""
        before, after, floor = self.cost
        return (before - after) / max(before - floor, 1e-9)
