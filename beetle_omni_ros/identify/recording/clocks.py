"""
Checks of stamps: order, times of recording, and lags between topics.

The age of a message is its time of recording minus its stamp. Computer load increases the age of
all topics, so each age is compared with the median age of the other topics at that time. Lags that
times of recording do not show are found by correlation of two motions. Both are series of lags,
which may be out of range, step or drift.
"""

import numpy as np

from beetle_omni_ros.identify.gap.bags import NEEDED, Recording
from beetle_omni_ros.identify.recording.damage import changed, Damage
from beetle_omni_ros.identify.recording.limits import RecordingLimits
from beetle_omni_ros.identify.recording.relations import Relation
from beetle_omni_ros.identify.recording.signals import Signals

FACTORS = {1e-9: 'nanoseconds', 1e-6: 'microseconds', 1e-3: 'milliseconds'}
OVERLAP = 6     # windows that share a sample; a motion counts once


def begin_of(recording: Recording) -> float:
    """First stamp of the IMU [s], the origin of stated times."""
    t = recording.times['imu/data_raw']
    return float(t[0]) if len(t) else 0.0


def clock_damages(recording: Recording, limits: RecordingLimits) -> list[Damage]:
    """Damages by stamps alone, at most one for each topic."""
    ages, found = relative_ages(recording, limits), []
    for topic in NEEDED:
        damage = _advance(recording, topic, limits) \
            or _age(recording, topic, ages, limits) \
            or _order(recording, topic, limits) or _repeats(recording, topic, limits)
        if damage:
            found.append(damage)
    return found


def _advance(recording, topic, limits):
    """Stamps that do not advance, or are in another unit."""
    t, received = recording.times[topic], recording.received.get(topic)
    ahead = np.diff(t)[np.diff(t) > 0]
    if len(ahead) < limits.few * len(t):
        return Damage(recording.name, topic, f'{len(t) - len(ahead)} of {len(t)} stamps do not '
                      f'advance (first stamp {t[0]:.3f} s)')
    period, (low, high) = float(np.median(ahead)), limits.period
    if low <= period <= high:
        return None
    cause = f'stamps are {period:g} s apart; expected {low:g} to {high:g} s'
    if received is not None and len(received) > 1:
        factor = max(float(np.median(np.diff(received))), 1e-12) / period
        unit = min(FACTORS, key=lambda f: abs(np.log(factor / f)))
        cause += f': {FACTORS[unit]} taken for seconds?' if 0.5 < factor / unit < 2 else ''
    return Damage(recording.name, topic, cause)


def _order(recording, topic, limits):
    """Stamps that go back: a clock that was set, or messages out of order."""
    t = recording.times[topic]
    steps = np.diff(t)
    back = np.flatnonzero(steps < 0)
    if len(back) > limits.few * len(t):
        order = np.argsort(t, kind='stable')
        return Damage(
            recording.name, topic, f'{len(back)} of {len(t)} messages are out of order by up to '
            f'{-steps.min():.3f} s: several sources on one topic, or a transport that reorders',
            t[back[0]], fix='sort the messages by stamp',
            repair=lambda r: changed(r, topic, keep=order))
    if steps.min() < -limits.period[1]:
        return Damage(recording.name, topic, f'the clock goes back by {-steps.min():.2f} s',
                      t[np.argmin(steps)])
    return None


def _repeats(recording, topic, limits):
    """Messages that were recorded twice, or two sources with the same stamps."""
    order = np.argsort(recording.times[topic], kind='stable')
    t, rows = recording.times[topic][order], recording.values[topic][order]
    same = np.diff(t) <= 0
    if same.sum() <= limits.few * len(t):
        return None
    cause = f'{int(same.sum())} of {len(t)} stamps occur twice with '
    equal = (rows[1:] == rows[:-1]).all(axis=1)
    if equal[same].mean() < 1 - limits.few:
        return Damage(recording.name, topic, f'{cause}other values: two sources publish on one '
                      'topic', t[np.argmax(same)])
    keep = order[np.concatenate([[True], ~same])]
    return Damage(recording.name, topic, f'{cause}the same values: messages were recorded twice',
                  t[np.argmax(same)], fix='keep each message once',
                  repair=lambda r: changed(r, topic, keep=keep))


def relative_ages(recording: Recording,
                  limits: RecordingLimits) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Topic -> times of recording (n,) [s], and ages (n,) relative to the other topics [s]."""
    known = {topic: recording.received[topic] for topic in NEEDED
             if len(recording.received.get(topic, ())) == len(recording.times[topic]) > 1}
    if len(known) < 3:
        return {}
    begin, end = max(r.min() for r in known.values()), min(r.max() for r in known.values())
    edges = np.arange(begin, end, limits.bin)
    medians = {}
    for topic, received in known.items():
        age, cuts = received - recording.times[topic], np.searchsorted(received, edges)
        medians[topic] = np.array([np.median(age[a:b]) if b > a else np.nan
                                   for a, b in zip(cuts[:-1], cuts[1:], strict=True)])
    result = {}
    for topic, own in medians.items():
        age = own - np.nanmedian([m for name, m in medians.items() if name != topic], axis=0)
        result[topic] = edges[:-1][np.isfinite(age)], age[np.isfinite(age)]
    return result


def _age(recording, topic, ages, limits):
    """Offset, step or drift of a topic's clock against the times of recording."""
    judged = judge(*ages[topic], limits.clock_offset, limits) \
        if topic in ages else None
    if not judged:
        return None
    cause, moment, late = judged
    t, received = recording.times[topic], recording.received[topic]
    if moment is not None:      # the message at the step
        near = np.flatnonzero(np.abs(received - moment) < 2 * limits.bin)
        k = near[np.argmax(np.abs(np.diff((received - t)[near])))] + 1
        moment, late = t[k], np.where(np.arange(len(t)) < k, *late(moment + [-1, 1]))
    else:
        late = late(received)
    return Damage(recording.name, topic, f'the clock {cause}, against the other topics recorded at '
                  'the same time: clocks of two computers differ, or another time base', moment,
                  fix='shift the stamps', repair=lambda r: changed(r, topic, times=t + late))


def lag_damage(name: str, relation: Relation, signals: Signals,
               limits: RecordingLimits) -> Damage | None:
    """A lag of two motions that is out of range, steps or drifts."""
    late, early = (np.linalg.norm(x, axis=1) for x in relation.pair(signals))
    judged = judge(*window_lags(signals.t, late, early, limits, signals.silent),
                   getattr(limits, relation.lag), limits)
    return Damage(name, relation.late, f'the clock of {relation.late} or of {relation.early} '
                  f'{judged[0]}, by {relation.words}', judged[1]) if judged else None


def judge(at: np.ndarray, lags: np.ndarray, allowed: np.ndarray, limits: RecordingLimits):
    """
    Whether lags (n,) [s] at times (n,) are out of range, step or drift; None if they are valid.

    Step and drift are compared with a constant lag by the likelihood of Laplace's distribution,
    which bears single wrong lags. They must also exceed the change ``limits.step``.

    Returns:
        cause in words, time of a step or None, function from times to lags.

    """
    n = len(lags)
    if n < 3:
        return None
    middle = float(np.median(lags))
    usual = np.abs(lags - middle).sum()
    total, counts = np.cumsum(lags - lags.mean())[:-1], np.arange(1, n)
    split = int(np.argmax(total**2 * (1 / counts + 1 / (n - counts)))) + 1
    before, after = float(np.median(lags[:split])), float(np.median(lags[split:]))
    slope, start = np.polyfit(at - at[0], lags, 1)
    drift = slope * (at[-1] - at[0])
    models = []
    if min(split, n - split) > 1:
        moment = 0.5 * (at[split - 1] + at[split])
        models.append((after - before, lambda t: np.where(t < moment, before, after), moment,
                       f'steps by {after - before:.2f} s: its lag is {before:.2f} s before and '
                       f'{after:.2f} s after'))
    models.append((drift, lambda t: start + slope * (t - at[0]), None, f'drifts by {slope:.2%}: '
                   f'its lag is {start:.2f} s at first and {start + drift:.2f} s at the end'))
    rest, (change, lag, moment, cause) = min(
        ((np.abs(lags - model[1](at)).sum(), model) for model in models), key=lambda x: x[0])
    noise = max(rest / n, limits.step / 10)
    if abs(change) > limits.step and (usual - rest) / noise > limits.prior:
        return cause, moment, lag
    if not allowed[0] <= middle <= allowed[1]:
        word = 'behind' if middle > 0 else 'ahead'
        return (f'is {abs(middle):.2f} s {word}, expected {allowed[0]:g} to {allowed[1]:g} s',
                None, lambda t: np.full(len(t), middle))
    return None


def window_lags(t: np.ndarray, late: np.ndarray, early: np.ndarray, limits: RecordingLimits,
                gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Time shifts between two similar series, by windows.

    Args:
        t: (N,) times [s].
        late: (N,) delayed magnitude.
        early: (N,) leading magnitude.
        limits: window, largest shift and least evidence.
        gaps: (N,) mask of times in a gap, whose windows are ignored.

    Returns:
        times (W,) of the motion in these windows [s], and shifts (W,) [s].

    """
    period = float(t[1] - t[0])
    length, reach, apart = (round(x / period) for x in (
        limits.window, limits.lag_reach, 1 / limits.edge))
    at, lags = [], []
    for first in range(0, len(t) - length + 1, length // OVERLAP):
        begin = max(0, first - reach)
        wide, own = early[begin:first + length + reach], late[first:first + length]
        if gaps[first:first + length].any():
            continue
        views = np.lib.stride_tricks.sliding_window_view(wide, length)
        views = views - views.mean(axis=1, keepdims=True)
        own = own - own.mean()
        alike = views @ own / (np.sqrt((views**2).sum(axis=1) * (own**2).sum()) + 1e-12)
        k = int(np.argmax(alike))
        far = np.abs(np.arange(len(alike)) - k) > apart
        # Evidence against no correlation, or against the best distant shift.
        other = max(0.0, alike[far].max(initial=0.0))
        count = limits.edge * limits.window
        if not 0 < k < len(alike) - 1 or alike[k] < 0 or 0.5 * count * np.log(
                (1 - other**2) / (1 - alike[k]**2 + 1e-12)) < limits.prior:
            continue
        a, b, c = alike[k - 1:k + 2]
        moment = np.average(t[first:first + length], weights=own**2)
        if at and moment < at[-1] + limits.window / OVERLAP:
            continue        # the same motion as in the window before
        at.append(moment)
        lags.append(period * (first - begin - k - 0.5 * (a - c) / min(a - 2 * b + c, -1e-12)))
    return np.array(at), np.array(lags)
