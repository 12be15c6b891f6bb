"""Regression of the unexplained residual on generic features: whether it is repeatable."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import orth

from beetle_omni_ros.identify.gap.bands import differs_between_bands
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.residual import CHANNELS, FlightModel, THIN
from beetle_omni_ros.identify.gap.series import matrices
from beetle_omni_ros.identify.inference.blocks import ridge_held_out
from beetle_omni_ros.identify.inference.noise import whitened

TERMS_SHOWN = 4
ALIKE = 1e-6            # relative singular value below which slopes are linearly dependent


@dataclass(frozen=True)
class Remainder:
    """
    Result of the generic regression.

    Attributes:
        gain: gain in chi2 on held-out blocks.
        positive: part of the blocks that gain.
        channels: (name, gain) of channels that gain, largest first.
        terms: (feature, gain) of the best features, largest first.
        frame: 'world', 'body', 'rotor' or 'joint'.
        size: channel -> RMS of the repeatable part, in the channel's unit.

    """

    gain: float = 0.0
    positive: float = 0.0
    channels: list[tuple[str, float]] = field(default_factory=list)
    terms: list[tuple[str, float]] = field(default_factory=list)
    frame: str = 'body'
    size: dict[str, float] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """One sentence."""
        where = ', '.join(name for name, _ in self.channels[:3]) or 'no channel'
        what = ', '.join(name for name, _ in self.terms[:TERMS_SHOWN]) or 'nothing tried'
        return (f'the residual is repeatable in {where} and correlates with {what} '
                f'({self.frame} frame); gain on held-out data: {self.gain:.0f} of chi2')


def features(model: FlightModel, theta: dict[str, float]) -> dict[str, np.ndarray]:
    """
    Generic regressors (N,) on the common grid, by 'frame: name'.

    Rates are not among them, because in closed loop they correlate with gusts.
    """
    x = model.inputs(theta)
    rotation, result = matrices(x['quaternion']), {}
    body = np.einsum('nji,nj->ni', rotation, x['velocity'])
    place = x['position'] - [0.0, 0.0, 1.0]
    axes = 'xyz'
    for k in range(3):
        result[f'body: v_{axes[k]}'] = body[:, k]
        result[f'body: |v| v_{axes[k]}'] = np.linalg.norm(body, axis=1) * body[:, k]
        for j in range(3):
            part = rotation[:, j, k]
            result[f'world: R_{axes[j]}{axes[k]}'] = part
            for i in range(3):
                result[f'world: {axes[i]} R_{axes[j]}{axes[k]}'] = place[:, i] * part
                result[f'world: {axes[i]}^2 R_{axes[j]}{axes[k]}'] = place[:, i]**2 * part
    for i in range(4):
        result[f'rotor: f_{i + 1}'] = x['thrust'][:, i]
        result[f'rotor: f_{i + 1}^2'] = x['thrust'][:, i]**2 / 10
        result[f'rotor: df_{i + 1}/dt'] = x['thrust_rate'][:, i] / 10
        for name, function in (('sin', np.sin), ('cos', np.cos)):
            angle = function(x['tilt'][:, i])
            result[f'rotor: {name} q_{i + 1}'] = angle
            result[f'rotor: f_{i + 1} {name} q_{i + 1}'] = x['thrust'][:, i] * angle
            result[f'rotor: f_{i + 1} {name} 2q_{i + 1}'] = x['thrust'][:, i] * function(
                2 * x['tilt'][:, i])
        result[f'joint: dq_{i + 1}/dt'] = x['tilt_rate'][:, i]
    result['rotor: voltage'] = 10 * (x['voltage'] - x['voltage'].mean())
    return result


def remainder(problem: Problem, state: State, names: list[str]) -> Remainder:
    """Regress the residual on generic features with cross-validation; project out fitted keys."""
    labels: list[str] = []
    columns = []
    for model in problem.models:
        result = features(model, state.theta)
        labels = labels or list(result)
        columns.append(np.stack(list(result.values()), axis=1))
    gains, total = {}, np.zeros(problem.blocks)
    best: dict[str, float] = {}
    size: dict[str, float] = {}
    channel = 0
    fitted = state.slopes[:, [state.index[n] for n in names]]
    for group, taps in problem.noise.taps.items():
        for k in range(len(taps)):
            rows = problem.where == channel
            channel += 1
            if group in 'AW':
                continue
            both = [_whitened(problem, model, group, k, result)
                    for model, result in zip(problem.models, columns, strict=True)]
            x, smooth = (np.concatenate([pair[i] for pair in both]) for i in (0, 1))
            held, scores, weights, explained, r = _cross_validated(
                x, fitted[rows], state.r[rows], problem.block[rows], problem.blocks,
                problem.p.remainder_ridge)
            name = CHANNELS[group][k]
            size[name] = float(np.sqrt(((smooth @ weights)**2).mean()))
            if group == 'B' and _closed_loop_bias(problem, rows, explained, r):
                continue
            gains[name] = float(held.sum())
            if held.sum() > 0:
                total += held
                for label, score in zip(labels, scores, strict=True):
                    best[label] = best.get(label, 0.0) + score
    channels = sorted(((n, g) for n, g in gains.items() if g > 10), key=lambda ng: -ng[1])
    terms = sorted(best.items(), key=lambda lg: -lg[1])[:TERMS_SHOWN]
    frame = terms[0][0].partition(':')[0] if terms else 'body'
    return Remainder(float(total.sum()), float((total > 0).mean()), channels,
                     [(label.partition(': ')[2], g) for label, g in terms], frame, size)


def _closed_loop_bias(problem, rows, explained, r):
    """Whether the regression in a channel of forces may be closed-loop bias."""
    x, all_r = np.zeros((len(rows), 1)), np.zeros(len(rows))
    x[rows, 0], all_r[rows] = explained, r
    return differs_between_bands(problem, x, all_r)


def _whitened(problem, model, group, channel, columns):
    """Features filtered like one channel's residual, whitened and not."""
    if group == 'J':
        first, count = model._starts[0], model._length * len(model._starts)
        columns = columns[first:first + count]
    elif group == 'B':
        columns = columns[::THIN]
    smooth = model.filters[group](columns)
    if group == 'B':
        smooth = model._mask[:, None] * smooth
    tap = problem.noise.taps[group][channel]
    return whitened(smooth, tap, problem.noise.sigma[group][channel]), smooth[len(tap) - 1:]


def _cross_validated(x, fitted, r, block, blocks, ridge):
    """
    Ridge regression with cross-validation.

    Returns:
        gain in chi2 on each block; score of each feature; weights of the fit to all blocks; the
        whitened residual that these explain; the residual with the fitted keys projected out.

    """
    scale = np.sqrt((x**2).mean(axis=0)) + 1e-12
    x = x / scale
    size = np.sqrt((fitted**2).sum(axis=0))
    used = size > 1e-3
    # QR would return rounding errors as further columns if columns are linearly dependent.
    basis = orth(fitted[:, used] / size[used], ALIKE) if used.any() else np.zeros((len(r), 0))
    x, r = x - basis @ (basis.T @ x), r - basis @ (basis.T @ r)
    weight = np.sqrt((x**2).mean(axis=0))
    x = x[:, weight > 0.05]
    size = (x**2).sum(axis=0)
    held, own = ridge_held_out(x, r, block, blocks, ridge * size.sum() / max(len(size), 1) / 100)
    scores, weights = np.zeros((2, len(weight)))
    scores[weight > 0.05], weights[weight > 0.05] = (x.T @ r)**2 / np.maximum(size, 1e-9), own
    return held.gains, scores, weights / scale, x @ own, r
