"""
Free runs: simulations from measured states and commands, compared with measurements.

Nothing is fitted here. Errors after 0.1, 0.5 and 1.0 s are divided by noise floors: the errors
that uncertain initial states, noisy readings and gusts cause in a perfect model.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from beetle_omni_ros.identify.gap.noise import Noise, white_noise
from beetle_omni_ros.identify.gap.residual import FlightModel, THIN
from beetle_omni_ros.identify.gap.series import low_pass
from beetle_omni_ros.identify.gap.servo import simulate, targets_at, windows_at
from beetle_omni_ros.identify.gap.signals import FINE, matrices
from beetle_omni_ros.robot.servo import play

HORIZONS = (0.1, 0.5, 1.0)      # [s]
STATES = ('position', 'velocity', 'orientation', 'rate', 'joint')
UNITS = dict(zip(STATES, ('m', 'm/s', 'rad', 'rad/s', 'rad'), strict=True))
PLAY = 'joint_backlash.gap'


@dataclass(frozen=True)
class Runs:
    """
    Errors of one flight's free runs.

    Attributes:
        error: (H, S, 5) norm of the error of each state at each horizon, for each start.
        regime: (S,) flight regime of each run.
        floor: (H, 5) noise floors.

    """

    error: np.ndarray
    regime: np.ndarray
    floor: np.ndarray


def free_runs(model: FlightModel, theta: dict[str, float], noise: Noise) -> Runs:
    """Free runs through one flight with the deviations ``theta``."""
    s, h = model.signals, model.p.grid
    steps, between = round(HORIZONS[-1] / h), round(model.p.run_every / h)
    starts = np.arange(0, len(s.t) - steps - 2, between)
    fine = np.array([model.trusted[k:k + steps + 1].all() for k in starts])
    starts = starts[fine] if fine.any() else starts
    inputs = model.inputs(theta)
    grid = starts[:, None] + np.arange(steps + 1)
    seen_shaft, shaft, tilt = _servo_runs(model, theta, starts, steps)
    rate = np.gradient(tilt, h, axis=1)
    acceleration = np.gradient(rate, h, axis=1)
    position = inputs['position'][starts].copy()
    velocity = inputs['velocity'][starts].copy()
    quaternion = inputs['quaternion'][starts].copy()
    turning = inputs['rate'][starts].copy()
    marks = [round(k / h) for k in HORIZONS]
    errors = []

    def slope(k, part, p, v, q, w):
        def at(x):
            return (1 - part) * x[:, k] + part * x[:, min(k + 1, steps)]
        rows = starts + k
        now = {'velocity': v, 'quaternion': q, 'rate': w, 'tilt': at(tilt), 'tilt_rate': at(rate),
               'tilt_acceleration': at(acceleration), 'position': p,
               'thrust': (1 - part) * inputs['thrust'][rows] + part * inputs['thrust'][rows + 1],
               'thrust_rate': inputs['thrust_rate'][rows], 'voltage': inputs['voltage'][rows],
               'charge': inputs['charge'][rows], 'modules': inputs['modules'][rows]}
        out = model._body(now, theta)
        force = np.einsum('nij,nj->ni', matrices(q), out[:, :3])
        force[:, 2] -= model.robot.gravity
        return force, out[:, 3:]

    for k in range(steps):
        a, b = slope(k, 0.0, position, velocity, quaternion, turning)
        middle = _turned(quaternion, 0.5 * h * turning)
        a, b = slope(k, 0.5, position + 0.5 * h * velocity, velocity + 0.5 * h * a, middle,
                     turning + 0.5 * h * b)
        position = position + h * velocity + 0.5 * h * h * a
        velocity = velocity + h * a
        quaternion = _turned(quaternion, h * (turning + 0.5 * h * b))
        turning = turning + h * b
        if k + 1 in marks:
            at = grid[:, k + 1]
            seen, shown = matrices(inputs['quaternion'][at]), matrices(quaternion)
            cosine = (np.einsum('nij,nij->n', seen, shown) - 1) / 2
            errors.append(np.stack([
                np.linalg.norm(inputs['position'][at] - position, axis=1),
                np.linalg.norm(inputs['velocity'][at] - velocity, axis=1),
                np.arccos(np.clip(cosine, -1, 1)),
                np.linalg.norm(inputs['rate'][at] - turning, axis=1),
                np.linalg.norm(seen_shaft[at] - shaft[:, k + 1], axis=1)], axis=1))
    return Runs(np.array(errors), _regimes(inputs, grid), noise_floor(model, noise))


def _servo_runs(model, theta, starts, steps):
    """
    Angles of the joints.

    Returns:
        (N, 4) encoder angles; (S, K + 1, 4) simulated servo angles; (S, K + 1, 4) angles of the
        rotors behind the backlash.

    """
    s, p = model.signals, model.p
    count = (steps + 1) * round(p.grid / p.servo_step)
    own = s.file.get(PLAY, 0.0)
    tilt, rate, _, _ = s.joints({**theta, PLAY: -own})
    gap = own + theta.get(PLAY, 0.0)
    edges = s.t[starts][:, None] + p.servo_step * np.arange(count + 1)
    index = np.clip(np.rint((edges[:, :-1] - s.t[0]) / p.grid).astype(int), 0, len(s.t) - 1)
    windows = windows_at(s, theta, index, (tilt[starts], rate[starts]), s.thrust(theta)[0], 0)
    run = simulate(model.robot, windows, targets_at(s, theta, edges)[None], [theta],
                   model.modules)[0]                                        # (K + 1, S, 4)
    behind = play(run, gap / 2, s.joints(theta)[0][starts]) if gap > 0 else run
    return tilt, run.transpose(1, 0, 2), behind.transpose(1, 0, 2)


def _turned(quaternion, vector):
    """Quaternions (N, 4) followed by rotation vectors (N, 3) of the body."""
    half = 0.5 * vector
    x, y, z, w = quaternion.T
    a, b, c = half.T
    result = np.stack([x + w * a + y * c - z * b, y + w * b - x * c + z * a,
                       z + w * c + x * b - y * a, w - x * a - y * b - z * c], axis=1)
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def _regimes(inputs, grid):
    """Dominant regime of each run: rotate, near ground, translate, tilted or hover."""
    speed = np.linalg.norm(inputs['velocity'], axis=1)[grid].mean(axis=1)
    turn = np.linalg.norm(inputs['rate'], axis=1)[grid].mean(axis=1)
    tilt = np.abs(inputs['tilt']).max(axis=1)[grid].mean(axis=1)
    low = inputs['position'][:, 2][grid].min(axis=1) < 0.6
    names = np.full(len(grid), 'hover', dtype=object)
    names[tilt > 1.0] = 'tilted'
    names[speed > 0.4] = 'translate'
    names[low] = 'near ground'
    names[turn > 0.8] = 'rotate'
    return names


def regimes_at(model: FlightModel, times: np.ndarray) -> np.ndarray:
    """Regime of the flight at each time (n,)."""
    inputs = model.inputs({})
    index = np.clip(np.rint((times - model.signals.t[0]) / model.p.grid).astype(int), 0,
                    len(model.signals.t) - 1)
    return _regimes(inputs, index[:, None])


def noise_floor(model: FlightModel, noise: Noise) -> np.ndarray:
    """(H, 5) RMS errors of a perfect model."""
    gravity, p = model.robot.gravity, model.p
    pose = white_noise(model.flight.pose)
    position = float(np.sqrt((pose[:3]**2).sum()))
    angle = 2 * float(np.sqrt((pose[3:]**2).sum()))
    rate = model.flight.imu[:, 3:]
    gyro = float(np.sqrt(((np.median(np.abs(np.diff(rate, 3, axis=0)), axis=0) / 0.6745)**2
                          / 20).sum()))
    # Readings at 100 Hz are interpolated to the fine grid, so neighbours have correlated noise.
    share = np.sqrt(2.0)
    coarse = model.signals.position_noise > p.coarse_noise
    slope = low_pass(p.velocity_edge if coarse else p.smooth_pose, 1, FINE)
    velocity0 = position * share * np.linalg.norm(
        slope(np.eye(1, 4 * slope.margin + 1, 2 * slope.margin)[0], 1))
    smooth = low_pass(p.smooth_imu, 1, FINE)
    rate0 = gyro * np.linalg.norm(smooth.taps)
    angle0 = angle * share * np.linalg.norm(low_pass(10.0, 1, FINE).taps)
    s = model.signals
    edge = p.smooth_joint if s.model_tilts is None else p.guide_edge
    joint0 = s.reading_noise * np.linalg.norm(low_pass(edge, 1, FINE).taps)
    push = _gust_errors(noise, p, gravity)
    floors = []
    for k, horizon in enumerate(HORIZONS):
        floors.append([
            2 * position**2 + (horizon * velocity0)**2 + (gravity * horizon**2 / 2 * angle0)**2
            + push[k][0]**2,
            2 * velocity0**2 + (gravity * horizon * angle0)**2 + push[k][1]**2,
            2 * angle0**2 + (horizon * rate0)**2 + push[k][2]**2,
            2 * rate0**2 + push[k][3]**2,
            4 * float(np.mean(noise.spread['J']**2)) + 8 * joint0**2])
    return np.maximum(np.sqrt(floors), p.run_floors)


def _gust_errors(noise, p, gravity):
    """
    Errors of position, velocity, angle and rate (H, 4) that gusts of the fit's noise cause.

    Torques also tilt the thrust. From half a second on, this moves the body more than the forces.
    """
    h = THIN * p.grid * p.body_every
    level = noise.seen.get('B', noise.sigma['B'])   # sigma contains the floors
    count = round(HORIZONS[-1] / h)
    rng = np.random.default_rng(0)
    once, twice = [], []
    for c in range(6):
        drive = level[c] * rng.standard_normal((p.run_draws, count + 60))
        pushed = lfilter([1.0], noise.taps['B'][c], drive, axis=1)[:, 60:]
        speed = np.cumsum(pushed, axis=1) * h
        once.append(speed)
        twice.append(np.cumsum(speed, axis=1) * h)
    # Rotations about two of three axes tilt the thrust.
    lean = [np.sqrt(2 / 3) * gravity * h * np.cumsum(angle, axis=1) for angle in twice[3:]]
    speeds, places = [*once[:3], *lean], [*twice[:3], *(h * np.cumsum(x, axis=1) for x in lean)]
    result = []
    for horizon in HORIZONS:
        k = round(horizon / h) - 1
        result.append([float(np.sqrt(sum((x[:, k]**2).mean() for x in part)))
                       for part in (places, speeds, twice[3:], once[3:])])
    return result


def floor_factors(fitted: list[Runs]) -> np.ndarray:
    """
    (H, 5) factors of the noise floors, at most 1, that lower them to the errors that are reached.

    Each fitted flight is compared with its own floor, because gusts differ between flights.
    """
    reached = np.mean([(run.error**2).mean(axis=1) / run.floor**2 for run in fitted], axis=0)
    return np.clip(np.sqrt(reached), 1e-2, 1.0)


def gap(runs: list[Runs], horizon: int, rows: str | None = None,
        trim: np.ndarray | None = None) -> float:
    """
    RMS over states of error over noise floor, at one horizon; 1 is pure noise.

    ``horizon`` is an index into HORIZONS, ``rows`` a regime, ``trim`` (H, 5) factors of each
    flight's floor from :func:`floor_factors`.
    """
    parts = []
    for run in runs:
        keep = np.ones(len(run.regime), bool) if rows is None else run.regime == rows
        if keep.any():
            floor = run.floor if trim is None else run.floor * trim
            parts.append((run.error[horizon][keep] / floor[horizon])**2)
    if not parts:
        return float('nan')
    return float(np.sqrt(np.concatenate(parts).mean()))
