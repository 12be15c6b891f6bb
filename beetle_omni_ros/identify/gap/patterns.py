"""
Tests for forces outside the catalogue, one hypothesis at a time.

A regression on all features at once has little power in gusts. Each hypothesis here is tested
alone: a force that depends on the place or the velocity, a thrust that depends on a state, or a
swinging mass. All six body channels are judged together on held-out blocks. A periodic force is
no function of the state; it is found as a line in the spectrum.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import bilinear, lfilter

from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import FlightModel, THIN
from beetle_omni_ros.identify.gap.series import matrices
from beetle_omni_ros.identify.inference.blocks import ridge_held_out
from beetle_omni_ros.identify.inference.noise import whitened

SWINGING = 'a mass that swings'
ROTORS = tuple(f'rotor_thrust_coefficient.scale[{k}]' for k in range(4))
WORLD = tuple(f'wind.force[{k}]' for k in range(3))


@dataclass(frozen=True)
class Pattern:
    """
    One hypothesis and its test.

    Attributes:
        text: description of the correlation.
        gain: gain in chi2 on held-out blocks.
        error: standard error of the gain.
        positive: part of the blocks that gain.
        size: RMS of specific force [m/s^2] and of angular acceleration [rad/s^2].

    """

    text: str
    gain: float
    error: float
    positive: float
    size: tuple[float, float]

    def agrees(self, p: GapParameters) -> bool:
        """Whether held-out blocks gain: enough of them evenly, or nearly all."""
        return any(self.gain > errors * self.error and self.positive >= part
                   for errors, part in p.pattern_agrees)


def patterns(problem: Problem, state: State, names: list[str]) -> list[Pattern]:
    """Tests of all hypotheses, largest gain first; the fitted keys are projected out."""
    by_flight = [hypotheses(model, state.theta) for model in problem.models]
    rows = problem.where < 6
    fitted = state.slopes[rows][:, [state.index[name] for name in names]]
    used = (fitted**2).sum(axis=0) > 1e-6
    fitted = fitted[:, used]
    index = [state.index[name] for name, keep in zip(names, used, strict=True) if keep]
    raw = [slopes['B'][:, :, index] for _, slopes, *_ in problem._raw]
    r = state.r[rows]
    r = r - fitted @ np.linalg.lstsq(fitted, r, rcond=None)[0]
    result = []
    for text in by_flight[0]:
        white, plain = zip(*(_in_residual(problem, model, each[text])
                             for model, each in zip(problem.models, by_flight, strict=True)),
                           strict=True)
        x = np.concatenate(white)
        known = np.linalg.lstsq(fitted, x, rcond=None)[0]
        x -= fitted @ known
        # Columns have typical size, so a weight is about one.
        held, weights = ridge_held_out(x, r, problem.block[rows], problem.blocks, 1.0)
        # The part that fitted keys absorb, such as a constant wind, is subtracted.
        size = np.sqrt(np.mean([((each @ weights - slopes @ (known @ weights))**2).mean(axis=0)
                                for each, slopes in zip(plain, raw, strict=True)], axis=0))
        result.append(Pattern(text, held.total, held.error, held.positive,
                              (float(np.linalg.norm(size[:3])), float(np.linalg.norm(size[3:])))))
    return sorted(result, key=lambda p: -p.gain)


def hypotheses(model: FlightModel, theta: dict[str, float]) -> dict[str, np.ndarray]:
    """Text -> (N, 6, K) specific force and angular acceleration of typical size, every THIN."""
    x = {name: values[::THIN] for name, values in model.inputs(theta).items()}
    exact = model._body.derivatives(x, theta, (*ROTORS, *WORLD))
    p = model.p
    rotor, world = p.pattern_thrust * exact[:, :, :4], p.pattern_force * exact[:, :, 4:]
    rotation = matrices(x['quaternion'])
    body = np.einsum('ncj,nji->nci', world, rotation)
    speed = np.linalg.norm(x['velocity'], axis=1)[:, None]
    own = np.einsum('nji,nj->ni', rotation, x['velocity'])
    time = THIN * p.grid * np.arange(len(speed))[:, None]
    tilts = np.concatenate([np.sin(x['tilt']), np.cos(x['tilt'])], axis=1)
    return {
        'the place': _products(world, _near_points(x['position'], p)),
        'the direction of motion': np.concatenate(
            [_products(world, x['velocity'] / (speed + 0.05)),
             _products(body, own / (speed + 0.05))], axis=2),
        'turns of the body, through thrust': _products(rotor, np.tanh(x['rate'])),
        'motion of the body, through thrust': _products(rotor, np.tanh(own)),
        'tilts of the rotors, through thrust': _products(rotor, tilts),
        'thrust of the rotors': _products(rotor, x['thrust'] / 8.0 - 1.0),
        'time of flight, through thrust': _products(rotor, np.concatenate(
            [1 - np.exp(-time / p.warm_up), time / time[-1]], axis=1)),
        SWINGING: _swinging_masses(model._body(x, theta)[:, :3], THIN * p.grid, p)}


def _products(forces, shares):
    """(N, 6, A B) products of all forces (N, 6, A) and all factors (N, B)."""
    both = forces[:, :, :, None] * shares[:, None, None, :]
    return both.reshape(*forces.shape[:2], -1)


def _near_points(position, p):
    """(N, B) proximity to the points of a grid in the plane, and height above 1 m."""
    corners = p.place_spacing * np.array([(i, j) for i in range(-2, 3) for j in range(-2, 3)])
    off = position[:, None, :2] - corners
    near = np.exp(-0.5 * (off**2).sum(axis=2) / p.place_width**2)
    return np.column_stack([near, position[:, 2] - 1.0])


def _swinging_masses(force, period, p):
    """
    (N, 6, K) forces on the body of masses on weak springs.

    ``force`` (N, 3) is the specific force of the model, sampled with ``period`` [s]. The measured
    one would contain the gusts.
    """
    size, twice = np.zeros((len(force), 6, 3 * len(p.swings))), 2 * p.swing_damping
    for j, frequency in enumerate(p.swings):
        w = 2 * np.pi * frequency
        b, a = bilinear([twice * w, w * w], [1.0, twice * w, w * w], 1 / period)
        # Without the force of a fixed mass, which is part of the robot's mass.
        swung = lfilter(b, a, force - force[0], axis=0) - (force - force[0])
        for k in range(3):
            size[:, k, k * len(p.swings) + j] = p.swing_mass * swung[:, k]
    return size


def _in_residual(problem, model, columns):
    """Columns (N, 6, K) filtered like one flight's residual, whitened and not."""
    smooth = model._mask[:, None, None] * model.filters['B'](columns)
    white = [whitened(smooth[:, c], tap, sigma) for c, (tap, sigma) in enumerate(zip(
        problem.noise.taps['B'], problem.noise.sigma['B'], strict=True))]
    return np.concatenate(white), smooth


@dataclass(frozen=True)
class SpectralLine:
    """
    The sharpest line in the spectrum of the residual.

    Attributes:
        frequency: frequency [Hz].
        ratio: power over the median of its neighbourhood.
        size: RMS [m/s^2].

    """

    frequency: float
    ratio: float
    size: float


def spectral_line(problem: Problem, theta: dict[str, float]) -> SpectralLine:
    """
    The sharpest line at one frequency in all flights, as of a periodic force; gusts have none.

    World and body axes are tried: a force with a fixed direction is constant in world axes, and
    that of a loose part in body axes.
    """
    h = THIN * problem.p.grid * problem.models[0].filters['B'].every
    rest = [(m.residual(theta, 'B')['B'][:, :3], _turns(m)) for m in problem.models]
    count = 2 * min(len(r) for r, _ in rest)
    best = SpectralLine(0.0, 0.0, 0.0)
    for frame in (0, 1):
        spectra = []
        for r, rotation in rest:
            r = np.einsum('nij,nj->ni', rotation, r) if frame == 0 else r
            window = np.hanning(len(r))[:, None]
            power = np.abs(np.fft.rfft((r - r.mean(axis=0)) * window, count, axis=0))**2
            spectra.append(2 * power.sum(axis=1) / (window.sum()**2))
        found = _line(np.fft.rfftfreq(count, h), np.mean(spectra, axis=0), problem.p)
        best = max(best, found, key=lambda line: line.ratio)
    return best


def _turns(model):
    """(M, 3, 3) rotations body to world at the samples of the body residual."""
    rotation = matrices(model.signals.pose({})[1])[::THIN]
    return rotation[model.filters['B'].centres(len(rotation))]


def _line(frequency, power, p):
    """The line with the largest ratio to its neighbourhood."""
    step = frequency[1]
    reach = round(p.line_beside / step)
    inside = np.flatnonzero((frequency > p.rhythms[0]) & (frequency < p.rhythms[1]))
    inside = inside[(inside >= reach) & (inside + reach < len(power))]
    beside = np.array([np.median(power[k - reach:k + reach + 1]) for k in inside])
    ratio = power[inside] / np.maximum(beside, 1e-30)
    top = int(np.argmax(ratio))
    return SpectralLine(float(frequency[inside[top]]), float(ratio[top]),
                        float(np.sqrt(power[inside[top]])))
