"""Analysis of checked flights: fit, search, free runs, verdict."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.identify.gap.bags import Recording
from beetle_omni_ros.identify.gap.body import BodyModel
from beetle_omni_ros.identify.gap.candidates import candidates, Found, Trial
from beetle_omni_ros.identify.gap.certainty import (
    Detectability,
    detectability,
    deviations,
    undetectable_limits,
)
from beetle_omni_ros.identify.gap.fit import Problem
from beetle_omni_ros.identify.gap.ingest import Flight
from beetle_omni_ros.identify.gap.keys import all_keys, extra_keys, Key, tolerances
from beetle_omni_ros.identify.gap.noise import ceilings, channels_above_ceiling, ExcessNoise
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.patterns import Pattern, patterns, spectral_line, SpectralLine
from beetle_omni_ros.identify.gap.residual import CHANNELS, FlightModel
from beetle_omni_ros.identify.gap.rollouts import (
    floor_factors,
    free_runs,
    gap,
    HORIZONS,
    regimes_at,
    Runs,
)
from beetle_omni_ros.identify.gap.search import Search
from beetle_omni_ros.identify.gap.unknown import Remainder, remainder
from beetle_omni_ros.identify.gap.verdict import decide, disagreement, not_met, withdraw
from beetle_omni_ros.identify.gap.workers import Workers
from beetle_omni_ros.identify.inference.blocks import HeldOut
from beetle_omni_ros.identify.recording.damage import Damage
from beetle_omni_ros.robot.parameters import RobotParameters

JUDGED = HORIZONS.index(0.5)
CLOSURES = (('closure', 'before', 'after'), ('placebo_closure', 'before', 'placebo'),
            ('closure_of_effects_alone', 'file', 'effects_alone'))


@dataclass
class Analysis:
    """
    All results.

    Attributes:
        verdict: a key of `results.WORDS`.
        reason: reason of the verdict.
        keys: all keys by name.
        found: result of the search.
        widths: key -> half width of its 95 % interval, as deviation.
        detectability: label -> detectability of a candidate.
        remainder: regression of the unexplained residual.
        patterns: tests of forces outside the catalogue, largest gain first.
        spectral_line: the sharpest line of the residual.
        where: channels and regimes, largest residual first.
        runs: 'before', 'after', 'placebo', ... -> free runs of the judging flights.
        gaps: horizon -> errors over noise floor, closures.
        regimes: regime -> errors before and after at 0.5 s.
        held_out: whether the judging flights were not fitted.
        problem: problem of the fit.
        models: (fitted flights, judging flights).
        experiment: next experiment, or None.
        findings: remarks of the checks.
        partial: effects that explain a part and are not named.
        damages: damages of the recordings.
        undetectable: limits, friction, play and effects of one regime that these flights would
            not show; set for no gap.
        damaged: recording of the first damage and that damage, for the page.
        above_ceiling: channels whose residual exceeds its ceiling after the fit.

    """

    verdict: str = 'no_gap'
    reason: str = ''
    keys: dict[str, Key] = field(default_factory=dict)
    found: Found = field(default_factory=Found)
    widths: dict[str, float] = field(default_factory=dict)
    detectability: dict[str, Detectability] = field(default_factory=dict)
    remainder: Remainder = field(default_factory=Remainder)
    patterns: list[Pattern] = field(default_factory=list)
    spectral_line: SpectralLine = SpectralLine(0.0, 0.0, 0.0)
    where: list[dict] = field(default_factory=list)
    runs: dict[str, list[Runs]] = field(default_factory=dict)
    gaps: dict[float, dict] = field(default_factory=dict)
    regimes: dict[str, dict] = field(default_factory=dict)
    held_out: bool = False
    problem: Problem | None = None
    models: tuple[list[FlightModel], list[FlightModel]] = field(default_factory=lambda: ([], []))
    experiment: str | None = None
    findings: list[str] = field(default_factory=list)
    partial: list[Trial] = field(default_factory=list)
    damages: list[Damage] = field(default_factory=list)
    above_ceiling: list[ExcessNoise] = field(default_factory=list)
    undetectable: list[str] = field(default_factory=list)
    damaged: tuple[Recording, Damage] | None = None

    @property
    def fit(self) -> Problem:
        """The problem of the fit; bad recordings have none."""
        if self.problem is None:
            raise ValueError('no flight was fitted: the recordings are bad')
        return self.problem

    @property
    def accepted(self) -> list[Trial]:
        """Named effects, largest gain first."""
        return sorted(self.found.accepted, key=lambda t: -t.gain)


def analyse(fitted: list[Flight], judging: list[Flight], robot: RobotParameters,
            p: GapParameters, progress: Callable[[str], None] = lambda text: None) -> Analysis:
    """
    Find the effects that explain the difference between flights and model.

    Without held-out flights (``judging``), the fitted ones also judge. ``progress`` gets a short
    text at each stage.
    """
    a = Analysis(held_out=bool(judging))
    a.keys = {**all_keys(robot), **extra_keys()}
    body = BodyModel(robot, a.keys, tilting_modules(robot))
    models = [FlightModel(flight, robot, body, a.keys, p) for flight in fitted]
    others = [FlightModel(flight, robot, body, a.keys, p) for flight in judging]
    a.models = models, others or models
    coarse = float(np.median([m.signals.position_noise for m in models])) > p.coarse_noise
    if coarse:
        a.findings.append('sensors are noisy: latencies within their usual range are not named')
    priors = tolerances(p, coarse, swing_of(robot))
    if robot.multibody is None or 'module_reaction' in robot.effects:
        del priors['modules.share']
    a.problem = Problem(models, a.keys, priors, p, others)
    _choose_modules(a.problem)
    with Workers(a.problem) as a.problem.workers:
        _find(a, progress)
    return a


def _find(a, progress):
    """Search, compute intervals and detectability, and decide."""
    models, p = a.models[0], a.problem.p
    tried = candidates(a.keys, models)
    search = Search(a.problem, tried, progress)
    a.found = search.run()
    accepted = [t.candidate for t in a.found.accepted]
    involved, free = search._involved(accepted), search._free(accepted)
    progress('certainty')
    a.widths = deviations(a.problem, a.found.state, involved, free)
    a.detectability = detectability(a.problem, a.found.state, search.always, tried)
    a.remainder = remainder(a.problem, a.found.state, involved)
    a.patterns = patterns(a.problem, a.found.state, involved)
    a.spectral_line = spectral_line(a.problem, a.found.theta)
    a.where = _where(a)
    a.above_ceiling = channels_above_ceiling(models, a.found.theta, p)
    decide(a, p)
    if a.verdict == 'no_gap':
        a.undetectable = [*not_met(a, p), *undetectable_limits(a.problem, a.found.state)]
    progress('free runs')
    _falsify(a, search.wide)


def tilting_modules(robot: RobotParameters) -> tuple[float, float]:
    """Inertia about the joint [kg m^2] and mass moment [kg m] of a module of the file."""
    if robot.multibody is None:
        return 0.0, 0.0
    module = robot.multibody.module
    depth = -float(module.centre_of_mass[2])
    return float(module.inertia[0] + module.mass * depth**2), float(module.mass * depth)


def swing_of(robot: RobotParameters) -> float:
    """Logarithm of the ratio of a module's inertia about its joint and the servo's inertia."""
    inertia = tilting_modules(robot)[0]
    return float(np.log(max(inertia / robot.joints.inertia, 1.0))) if inertia else 0.0


def _choose_modules(problem):
    """Use the file's tilting modules in the model if the data agree better with them."""
    if 'modules.share' not in problem.priors:
        return
    costs = []
    for share in (0.0, 1.0):
        for model in problem.all_models:
            model.modules = share
        r = problem.residual({})
        costs.append(float(np.minimum(r * r, 100.0).sum()))
    for model in problem.all_models:
        model.modules = float(np.argmin(costs))


def _where(a):
    """Channels and regimes, ranked by the residual of the model without effects."""
    problem, rows = a.problem, []
    r = problem.residual(a.found.base)
    after = a.found.state.r
    regimes = np.concatenate([regimes_at(m, problem.time[problem.flight == k])
                              for k, m in enumerate(problem.models)])
    names = [name for group in problem.noise.taps for name in CHANNELS[group]]
    for channel, name in enumerate(names):
        for regime in np.unique(regimes):
            keep = (problem.where == channel) & (regimes == regime)
            if keep.sum() >= 20:
                rows.append({'channel': name, 'regime': str(regime),
                             'excess': float(np.sqrt((r[keep]**2).mean())),
                             'excess_after': float(np.sqrt((after[keep]**2).mean()))})
    return sorted(rows, key=lambda row: -row['excess'])


def _falsify(a, wide):
    """Free runs before, after and with a placebo, on the judging flights."""
    found, judges = a.found, a.models[1]
    a.problem.smooth_tilts(found.theta, judges)
    keys, refused = ({n for t in trials for n in t.candidate.keys}
                     for trials in (found.accepted, a.partial))
    # Partial effects are not named, so they close no gap.
    reached = {n: x for n, x in found.theta.items() if n not in refused}
    reached |= {n: found.base[n] for n in refused if n in found.base}
    # Tolerances as fitted, without and with the named effects ...
    points = {'before': {n: x for n, x in reached.items() if n not in keys}, 'after': reached}
    # ... and the robot file alone, and with the named effects only.
    plain = _plain(a, reached, keys)
    points |= {'file': plain, 'effects_alone': {**plain, **{n: found.theta[n] for n in keys}},
               'placebo': _placebo(a)}
    all_models = a.problem.all_models
    noise = [own.bounded(ceilings(model, a.problem.p)) for model, own in zip(
        all_models, a.problem.noise_of_each(found.theta, wide), strict=True)]
    fitted, judging = range(len(a.models[0])), [all_models.index(model) for model in judges]
    if not found.accepted:
        points = {name: points[name] for name in ('before', 'file')}
    flown = iter(a.problem.parallel(_flown, [(theta, k) for theta in points.values()
                                             for k in judging], noise))
    for name in points:
        a.runs[name] = [next(flown) for _ in judges]
    for name, same in (('after', 'before'), ('placebo', 'before'), ('effects_alone', 'file')):
        a.runs.setdefault(name, a.runs[same])
    trim = floor_factors(a.problem.parallel(_flown, [(found.theta, k) for k in fitted], noise))
    _measure(a, trim)
    why = _refuted(a, trim) if found.accepted else ''
    if why:
        withdraw(a, a.gaps[HORIZONS[JUDGED]], why)
        a.runs |= {'after': a.runs['before'], 'effects_alone': a.runs['file'],
                   'placebo': a.runs['before']}
        _measure(a, trim)
    for regime in np.unique(np.concatenate([run.regime for run in a.runs['before']])):
        before, after = (gap(a.runs[name], JUDGED, regime, trim)
                         for name in ('before', 'after'))
        a.regimes[str(regime)] = {'before': before, 'after': after,
                                  'worse': bool(after > a.problem.p.regime_worse * before)}
    disagreement(a, a.gaps[HORIZONS[JUDGED]]['before'])


def _flown(problem, item, noise):
    """Free runs of a flight with given deviations."""
    theta, k = item
    return free_runs(problem.all_models[k], theta, noise[k])


def _refuted(a, trim):
    """How the judging flights refute the named effects, as the end of a sentence; or ''."""
    judged, p = a.gaps[HORIZONS[JUDGED]], a.problem.p
    before, after = judged['before'], judged['after']
    if not np.isfinite([before, after]).all():
        return 'makes free runs diverge'
    if a.held_out and after > max(p.at_floor, p.regime_worse * before):
        return 'makes the held-out ones worse'
    if after > max(p.far_off, 1 + (1 - p.least_closed) * (before - 1)):
        return 'does not explain most of the error of free runs'
    if not a.held_out:
        return ''
    fall, scatter = _fall(a.runs['before'], a.runs['after'], trim, p.runs_a_block)
    if after > p.at_floor and fall < -p.clearly_worse * scatter:
        return 'makes the held-out ones worse'
    gain = _gain_held_out(a)
    if fall <= scatter and gain.total <= gain.error:
        return 'does not improve the held-out ones by more than their scatter'
    return ''


def _fall(before, after, trim, together):
    """Mean decrease of the squared gap at 0.5 s over blocks of runs, and its standard error."""
    falls = []
    for one, other in zip(before, after, strict=True):
        floor = one.floor[JUDGED] * trim[JUDGED]
        each = ((one.error[JUDGED]**2 - other.error[JUDGED]**2) / floor**2).mean(axis=1)
        count = max(1, len(each) // together)
        falls += [part.mean() for part in np.array_split(each, count)]
    error = np.std(falls, ddof=1) / np.sqrt(len(falls)) if len(falls) > 1 else 0.0
    return float(np.mean(falls)), float(error)


def _gain_held_out(a):
    """Gain in chi2 on held-out flights, with the noise of the fit."""
    judges = Problem(a.models[1], a.problem.keys, a.problem.priors, a.problem.p)
    judges.use(a.problem.noise)
    before, after = (judges.residual(theta)**2 for theta in (a.found.base, a.found.theta))
    return HeldOut(np.array([(before - after)[judges.block == b].sum()
                             for b in range(judges.blocks)]))


def _measure(a, trim):
    """Set the errors at each horizon and the closures."""
    for h, horizon in enumerate(HORIZONS):
        values = {name: gap(runs, h, trim=trim) for name, runs in a.runs.items()}
        a.gaps[horizon] = values | {name: closure(values[before], values[after],
                                                  a.problem.p.at_floor)
                                    for name, before, after in CLOSURES}


def _plain(a, theta, named):
    """The robot file, with delays and mounting of the sensors and of the bus as fitted."""
    return {name: x for name, x in theta.items() if not a.keys[name].body
            and a.keys[name].effect not in ('rotor_lag', 'joint_bandwidth', 'modules', 'swing',
                                            'rotor', 'servo')
            and name in a.problem.priors and name not in named}


def closure(before: float, after: float, at_floor: float) -> float | None:
    """Closed share of the excess over the noise floor (1); None if there was no excess."""
    if not before > at_floor:
        return None
    return float(1 - max(after**2 - 1, 0.0) / (before**2 - 1))


def _placebo(a) -> dict[str, float]:
    """The named effects with the opposite sign, as a control that must not help."""
    theta = dict(a.found.theta)
    for trial in a.found.accepted:
        for name in trial.candidate.keys:
            key = a.keys[name]
            # Body equations accept any sign; a servo with negative friction is unstable.
            theta[name] = -theta[name] if key.body else float(
                np.clip(-theta[name], key.low, key.high))
    return theta
