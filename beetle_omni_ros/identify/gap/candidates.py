"""Catalogue entries as candidates of a fit: free keys, form and starting points."""

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.fit import State
from beetle_omni_ros.identify.gap.keys import Key, MODULES
from beetle_omni_ros.identify.gap.residual import FlightModel
from beetle_omni_ros.identify.inference.blocks import HeldOut
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.servo import NUMPY, Servo

# Reasons of a rejection.
TOO_SMALL = 'smaller than the smallest relevant size'
IMPOSSIBLE = 'value is physically impossible'
NOT_CONFIRMED = 'held-out blocks do not confirm it'
CLOSED_LOOP_BIAS = 'only in slow or only in fast motion, as with closed-loop bias by gusts'


@dataclass(frozen=True)
class Candidate:
    """
    One form of a catalogue entry.

    Attributes:
        name: catalogue name.
        keys: free keys.
        fixed: deviations that select the form.
        starts: starting deviations, each complete for ``keys``; () is zero.
        label: unique name.
        member: number of the rotor or joint, or None.

    """

    name: str
    keys: tuple[str, ...]
    fixed: dict[str, float] = field(default_factory=dict)
    starts: tuple[tuple[float, ...], ...] = ()
    label: str = ''
    member: int | None = None

    def acts_on_body_only(self, keys: dict[str, Key]) -> bool:
        """Whether it changes only forces and torques on the body, as gusts do."""
        return all(keys[name].groups == 'B' for name in self.keys)

    def large_enough(self, keys: dict[str, Key], theta: dict[str, float]) -> bool:
        """Whether a deviation has at least the smallest relevant size."""
        if CATALOGUE[self.name].limit:
            return True
        return any(abs(theta.get(name, 0.0)) >= keys[name].smallest for name in self.keys)


def candidates(keys: dict[str, Key], models: list[FlightModel]) -> list[Candidate]:
    """All candidates; starts of limits depend on the flights."""
    result = []
    for name, effect in CATALOGUE.items():
        own = tuple(key.name for key in keys.values() if key.effect == name
                    and not key.form)
        if not own:
            continue
        if effect.each:
            result += [Candidate(name, (key,), label=f'{name}[{k + 1}]', member=k + 1)
                       for k, key in enumerate(own)]
        elif name == MODULES:
            result += [Candidate(name, own[:1], label=f'{name} (inertia)'),
                       Candidate(name, own, label=name)]
        else:
            starts = limit_starts(keys[own[0]], effect, models) if effect.limit else effect.starts
            if effect.starts and not starts:
                continue
            result += [Candidate(name, own, {f'{name}.{part}': x for part, x in form.items()},
                                 starts, name + (f' ({k + 1})' if k else ''))
                       for k, form in enumerate(effect.forms)]
    return result


def limit_starts(key, effect, models):
    """Starts at which a limit begins to act in these flights."""
    what, below = effect.limit
    most = max(float({
        'tilt_rate': lambda m: np.abs(m.signals.joints({})[1]).max(),
        'torque': lambda m: np.quantile(np.abs(_torques(m)), 0.999),
        'thrust': lambda m: np.quantile(m.flight.command[:, 4:], 0.999)}[what](m))
        for m in models)
    return tuple((float(np.log(part * most / key.base)),) for part, in effect.starts
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


@dataclass
class Trial:
    """
    Result of a fit with one more candidate.

    Attributes:
        candidate: the candidate.
        gain: decrease of the objective.
        theta: all deviations with it.
        refined: whether fitted; else a linear estimate.
        prior_gain: part of ``gain`` in the priors of tolerances.
        held: gains on held-out blocks.
        share: part of the unexplained objective.
        reason: reason of the rejection, '' if accepted.

    """

    candidate: Candidate
    gain: float
    theta: dict[str, float]
    refined: bool = False
    prior_gain: float = 0.0
    held: HeldOut = HeldOut(np.zeros(1))
    share: float = 0.0
    reason: str = ''


@dataclass
class Found:
    """
    Result of a search.

    Attributes:
        accepted: accepted trials in order.
        trials: label -> last trial of each candidate.
        rivals: label of an accepted candidate -> trials that explain as much in its place.
        base: deviations of the fit without effects.
        theta: deviations of the final fit.
        state: the final fit, with slopes of all keys.
        cost: objectives of base fit, final fit, and linear fit of all keys.
        low_excitation: whether the motion is mostly a reaction to disturbances; see
            :func:`~beetle_omni_ros.identify.gap.certainty.excitation`.

    """

    accepted: list[Trial] = field(default_factory=list)
    trials: dict[str, Trial] = field(default_factory=dict)
    rivals: dict[str, list[Trial]] = field(default_factory=dict)
    base: dict[str, float] = field(default_factory=dict)
    theta: dict[str, float] = field(default_factory=dict)
    state: State = field(
        default_factory=lambda: State({}, np.zeros(0), np.zeros((0, 0)), []))
    cost: tuple[float, float, float] = (0.0, 0.0, 0.0)
    low_excitation: bool = False

    @property
    def explained(self) -> float:
        """Part of the explainable objective that the accepted entries explain."""
        before, after, floor = self.cost
        return (before - after) / max(before - floor, 1e-9)
