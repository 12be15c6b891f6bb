"""
Uncertainty of a servo model: intervals, inseparable pairs, and a separating experiment.

Intervals are profile likelihoods of the whitened residuals without prior. Each parameter is moved
and held, all others are fitted, until the increase of chi2 is that of 95 %. The increase is
divided by the scatter of the gradient of chi2 between blocks, which is 1 for white residuals.
"""

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.inference.least_squares import covariance
from beetle_omni_ros.identify.inference.noise import Noise
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_fit import decode, encode, Problems, ServoFitter, SINGLE_JOINT
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, simulate, TERMS

RISE = 3.84             # 95 % quantile of chi2 with one degree of freedom
PROFILED = ('natural_frequency', 'damping_ratio', 'delay')
LADDER = np.array([0.5, 1.2, 2.2, 3.6, 5.5, 8.0, 12.0, 18.0])  # in scales of a term
LOW, HIGH = SINGLE_JOINT.coordinates.low, SINGLE_JOINT.coordinates.high


@dataclass(frozen=True)
class Uncertainty:
    """
    Uncertainty of one joint's parameters.

    Attributes:
        intervals: (n, 2) 95 % intervals; NaN if not free.
        correlation: (n, n) correlation of the free parameters, in fitted units.
        scatter: divisor of chi2.

    """

    intervals: np.ndarray
    correlation: np.ndarray
    scatter: float

    def half_width(self, name: str) -> float:
        """Half width of an interval in scales of the parameter."""
        index, term = INDEX[name], TERMS[name]
        low, high = self.intervals[index]
        if term.logarithmic:
            low, high = np.log(low), np.log(high)
        return float((high - low) / 2 / term.scale)


def uncertainties(log: JointLog, noise: Noise, problems: Problems,
                  profiled: np.ndarray) -> list[Uncertainty]:
    """
    Uncertainties of fitted parameter sets, one for each row of ``problems``.

    Rows of the mask ``profiled`` (B,) get profile likelihoods, the others linear intervals.
    """
    fitter, results = ServoFitter(log, noise), []
    for point, free, (own, scatter) in zip(problems.points, problems.free,
                                           fitter.covariances(problems), strict=True):
        size = np.sqrt(np.maximum(scatter * np.diag(own), 1e-30))
        width = np.sqrt(RISE) * np.where(free, size, np.nan)
        intervals = np.stack([decode(np.clip(point + side * width, LOW, HIGH))
                              for side in (-1, 1)], axis=1)
        results.append(Uncertainty(intervals, scatter * own / np.outer(size, size), scatter))
    wanted = np.flatnonzero(profiled)
    _profile(fitter, problems.pick(wanted), [results[k] for k in wanted])
    return results


def _profile(fitter, problems, results):
    """Replace the intervals of nonlinear parameters by profile likelihoods."""
    parts, owner = [], []
    for k in range(len(problems.joints)):
        for name in PROFILED:
            index = INDEX[name]
            if not problems.free[k, index]:
                continue
            for side in (-1, 1):
                for move in LADDER:
                    parts.append(_held(problems.pick([k]), index, side * move))
                    owner.append((k, index, side, move))
    fits = fitter.solve(Problems.join([problems, *parts]), 10)
    count, refitted = len(problems.joints), fits.points
    best, chi2 = fits.chi2[:count].copy(), fits.chi2[count:]
    for (k, *_), value in zip(owner, chi2, strict=True):
        best[k] = min(best[k], value)
    paths: dict = {}
    for k, index, side in dict.fromkeys(entry[:3] for entry in owner):
        rows = [k] + [count + i for i, entry in enumerate(owner)
                      if entry[:3] == (k, index, side)]
        rise = np.maximum((fits.chi2[rows] - best[k]) / results[k].scatter, 0.0)
        if (rise > RISE).all():     # a better fit is elsewhere: keep the linear interval
            continue
        place = _crossing(rise)
        centre = problems.points[k]
        ends = np.array([np.interp(place, np.arange(len(rows)), refitted[rows, n])
                         for n in range(len(NAMES))])
        ends[index] = np.clip(centre[index] + side * np.interp(
            place, np.arange(len(rows)), [0.0, *LADDER]), LOW[index], HIGH[index])
        paths[k, index, side] = ends
        results[k].intervals[index, (side + 1) // 2] = decode(ends)[index]
    _correlate(paths, results)


def _correlate(paths, results):
    """Set correlations of profiled pairs: motion of one along the interval of the other."""
    for k, result in enumerate(results):
        profiled = [index for row, index, side in paths
                    if row == k and side > 0 and (k, index, -1) in paths]
        reach = {index: paths[k, index, 1] - paths[k, index, -1] for index in profiled}
        for a in profiled:
            for b in profiled:
                if a != b:
                    drawn = [reach[a][b] / max(reach[b][b], 1e-9),
                             reach[b][a] / max(reach[a][a], 1e-9)]
                    result.correlation[a, b] = np.clip(max(drawn, key=abs), -1, 1)


def _held(problem, index, move):
    """The problem with one parameter moved and held, and the total lag of servo and delay kept."""
    point = problem.points.copy()
    point[0, index] = np.clip(point[0, index] + move, LOW[index], HIGH[index])
    free = problem.free.copy()
    free[0, index] = False
    before, sets = decode(problem.points), decode(point)
    frequency, damping, delay = (INDEX[name] for name in PROFILED)
    lag = [2 * s[0, damping] / s[0, frequency] for s in (before, sets)]
    if index == delay:
        change = sets[0, delay] - before[0, delay]
        sets[0, frequency] *= lag[0] / max(lag[0] - change, 0.1 * lag[0])
    elif problem.free[0, delay]:
        sets[0, delay] = max(0.0, sets[0, delay] + lag[0] - lag[1])
    return replace(problem, points=encode(sets), free=free)


def _crossing(rise):
    """Fractional index at which the rise reaches that of 95 %; the last one if it never does."""
    last = np.flatnonzero(rise <= RISE)[-1]
    if last == len(rise) - 1:
        return float(last)
    k = last + 1
    # Linear interpolation of the square root, because chi2 is nearly quadratic.
    a, b = np.sqrt(rise[[k - 1, k]])
    return k - 1 + (np.sqrt(RISE) - a) / max(b - a, 1e-9)


def inseparable_pairs(result: Uncertainty, names: list[str]) -> list[list[str]]:
    """Pairs of parameters that the log does not separate, largest correlation first."""
    loose = [name for name in names if result.half_width(name) > shipped().servo.loose]
    pairs = [(abs(result.correlation[INDEX[a], INDEX[b]]), a, b)
             for k, a in enumerate(loose) for b in loose[:k]]
    return [sorted([a, b]) for r, a, b in sorted(pairs, reverse=True)
            if r >= shipped().servo.traded]


SINE_PERIOD = 0.01      # [s] sampling period


@dataclass(frozen=True)
class Experiment:
    """
    A sine log that separates delay and bandwidth.

    Attributes:
        frequency: frequency [Hz].
        amplitude: amplitude [rad].
        duration: duration [s].
        delay_width: half width of the delay's 95 % interval with it [s].
        frequency_width: half width of that of the natural frequency [rad/s].

    """

    frequency: float
    amplitude: float
    duration: float
    delay_width: float
    frequency_width: float


def separating_experiments(sets: np.ndarray, free: np.ndarray, noise: Noise, scatter: np.ndarray,
                           wanted: float = 0.001) -> list[Experiment]:
    """
    The slowest sine that determines every joint's delay, from the sensitivities of the model.

    Args:
        sets: (n, m) fitted parameter sets, one for each joint.
        free: (n, m) free parameters; the delay is added.
        noise: noise of the fitted log, also assumed for the experiment.
        scatter: (n,) divisor of chi2, see :class:`Uncertainty`.
        wanted: half width of the delay's interval [s].

    Returns:
        the experiment for each joint; if no sine reaches ``wanted``, the best.

    """
    free = free.copy()
    free[:, INDEX['delay']] = True
    best: list[Experiment] = []
    for found in _plans(sets, free, noise, scatter):
        worst = max(plan.delay_width for plan in found)
        if not best or worst < max(plan.delay_width for plan in best):
            best = found
        if worst <= wanted:
            break
    return best


def _plans(sets, free, noise, scatter):
    """Experiments of all joints for each frequency, in one simulation."""
    count, many = len(sets), len(shipped().servo.sines)
    t = np.arange(0.0, shipped().servo.sine_time, SINE_PERIOD)
    omega = 2 * np.pi * np.repeat(shipped().servo.sines, count)
    amplitude = np.minimum(shipped().servo.sine_amplitude, shipped().servo.sine_speed / omega)
    command = amplitude[:, None] * np.sin(omega[:, None] * t)
    sets, free = np.tile(sets, (many, 1)), np.tile(free, (many, 1))
    noise = Noise(np.tile(noise.taps, (many, 1)), np.tile(noise.sigma, many))
    rows = np.arange(count * many)
    blank = JointLog('', t, tuple(rows.tolist()), np.zeros_like(command), command)
    log = JointLog('', t, blank.joints, simulate(blank, rows, sets), command)
    weight = np.tile((t >= 1.0).astype(float), (len(rows), 1))
    fitter, problems = ServoFitter(log, noise), Problems.single_joints(rows, sets, free, weight)
    slopes = fitter.jacobian(problems, fitter.residuals(problems.points, problems.joints, weight))
    information = slopes @ slopes.transpose(0, 2, 1)
    f, d = INDEX['natural_frequency'], INDEX['delay']
    scale = np.array([term.scale for term in TERMS.values()])
    plans = []
    for row, factor in zip(rows, np.tile(scatter, many), strict=True):
        width = np.sqrt(RISE * factor * np.diag(covariance(information[row], free[row]))) * scale
        plans.append(Experiment(float(omega[row] / 2 / np.pi), float(amplitude[row]),
                                shipped().servo.sine_time, float(width[d]),
                                float(width[f] * sets[row, f])))
    return [plans[k:k + count] for k in range(0, len(plans), count)]
