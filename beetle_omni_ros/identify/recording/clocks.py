"""
Checks of stamps: order, times of recording, and lags between topics.

The age of a message is its time of recording minus its stamp. Computer load increases the age of
all topics, so each age is compared with the median age of the other topics at that time. Lags that
times of recording do not show are found by correlation of two motions. Both are series of lags,
which may be out of range, step or drift.
"""

import numpy as np

from beetle_omni_ros.identify.gap.bags import NEEDED, Recording
from beetle_omni_ros.identify.recording.damage import changed, Damage, IMU
from beetle_omni_ros.identify.recording.limits import shipped
from beetle_omni_ros.identify.recording.relations import Relation
from beetle_omni_ros.identify.recording.signals import Signals

OVERLAP = 6     # windows that share a sample; a motion counts once


def begin_of(recording: Recording) -> float:
    """First stamp of the IMU [s], the origin of stated times."""
    return float(recording.times[IMU][0]) if len(recording.times[IMU]) else 0.0


def clock_damages(recording: Recording) -> list[Damage]:
    """Damages by stamps alone, at most one for each topic."""
    ages = relative_ages(recording)
    found = (_advance(recording, topic) or _age(recording, topic, ages)
             or _order(recording, topic) for topic in NEEDED)
    return [damage for damage in found if damage]


def _advance(recording, topic):
    """Stamps that do not advance, or are in another unit."""
    steps, (low, high) = np.diff(recording.times[topic]), shipped().period
    ahead = steps[steps > 0]
    if len(ahead) < shipped().few * len(steps):
        return Damage(recording.name, topic, f'{len(steps) - len(ahead)} of {len(steps)} stamps '
                      f'do not advance (first stamp {recording.times[topic][0]:.3f} s)')
    period = float(np.median(ahead))
    return None if low <= period <= high else Damage(
        recording.name, topic, f'stamps are {period:g} s apart; expected {low:g} to {high:g} s: '
        'another unit taken for seconds, such as milliseconds or nanoseconds?')


def _order(recording, topic):
    """Stamps that go back far, or occur twice with other values."""
    t, steps = recording.times[topic], np.diff(recording.times[topic])
    if steps.min() < -shipped().period[1]:
        return Damage(recording.name, topic, f'the clock goes back by {-steps.min():.2f} s',
                      t[np.argmin(steps)])
    order = np.argsort(t, kind='stable')
    rows = recording.values[topic][order]
    twice = (np.diff(t[order]) <= 0) & (rows[1:] != rows[:-1]).any(axis=1)
    return None if twice.mean() <= shipped().few else Damage(
        recording.name, topic, f'{twice.sum()} of {len(t)} stamps occur twice with other values: '
        'two sources publish on one topic', t[order][np.argmax(twice)])


def relative_ages(recording: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Topic -> times of recording (n,) [s], and ages (n,) relative to the other topics [s]."""
    known = {topic: recording.received[topic] for topic in NEEDED
             if len(recording.received.get(topic, ())) == len(recording.times[topic]) > 1}
    if len(known) < 3:
        return {}
    edges = np.arange(max(r.min() for r in known.values()), min(r.max() for r in known.values()),
                      shipped().bin)
    medians, result = {}, {}
    for topic, received in known.items():
        age, cuts = received - recording.times[topic], np.searchsorted(received, edges)
        medians[topic] = np.array([np.median(age[a:b]) if b > a else np.nan
                                   for a, b in zip(cuts[:-1], cuts[1:], strict=True)])
    for topic, own in medians.items():
        age = own - np.nanmedian([m for name, m in medians.items() if name != topic], axis=0)
        result[topic] = edges[:-1][np.isfinite(age)], age[np.isfinite(age)]
    return result


def _age(recording, topic, ages):
    """Offset, step or drift of a topic's clock against the times of recording."""
    at, lags = ages.get(topic, ((), ()))
    judged = judge(at, lags, shipped().clock_offset, shipped().clock_step)
    if not judged:
        return None
    cause, moment, late_at = judged
    t, received = recording.times[topic], recording.received[topic]
    late = late_at(received)
    if moment is not None:      # the message at the step
        near = np.flatnonzero(np.abs(received - moment) < 2 * shipped().bin)
        k = near[np.argmax(np.abs(np.diff((received - t)[near])))] + 1
        moment, late = t[k], np.where(np.arange(len(t)) < k, late[0], late[-1])
    return Damage(recording.name, topic, f'the clock {cause}, against the other topics recorded '
                  'at the same time: clocks of two computers differ, or another time base', moment,
                  fix='shift the stamps', repair=lambda r: changed(r, topic, times=t + late))


def lag_damage(name: str, relation: Relation, signals: Signals) -> Damage | None:
    """A lag of two motions that is out of range, steps or drifts."""
    late, early = (np.linalg.norm(x, axis=1) for x in relation.pair(signals))
    at, lags = window_lags(signals.t, late, early, signals.silent)
    judged = judge(at, lags, getattr(shipped(), relation.lag), shipped().lag_step)
    return Damage(name, relation.late, f'the clock of {relation.late} or of {relation.early} '
                  f'{judged[0]}, by {relation.words}', judged[1]) if judged else None


def judge(at: np.ndarray, lags: np.ndarray, allowed: np.ndarray, least: float) -> list | None:
    """
    Whether lags (n,) [s] at times (n,) are out of range, step or drift; None if they are valid.

    Step and drift are compared with a constant lag by the likelihood of Laplace's distribution,
    which bears single wrong lags. They must also exceed the change ``least`` [s].

    Returns:
        cause in words, time of a step or None, function from times to lags.

    """
    n = len(lags)
    if n < 4:
        return None
    middle, usual = float(np.median(lags)), np.abs(lags - np.median(lags)).sum()
    # Largest difference of means, weighted by their numbers of values, of two or more values.
    total, counts = np.cumsum(lags - lags.mean())[:-1], np.arange(1, n)
    split = int(np.argmax((total**2 * (1 / counts + 1 / (n - counts)))[1:-1])) + 2
    before, after = float(np.median(lags[:split])), float(np.median(lags[split:]))
    slope, start = np.polyfit(at - at[0], lags, 1)
    drift, moment = slope * (at[-1] - at[0]), 0.5 * (at[split - 1] + at[split])
    models = (
        (after - before, f'steps by {after - before:.2f} s: its lag is {before:.2f} s before and '
         f'{after:.2f} s after', moment, lambda t: np.where(t < moment, before, after)),
        (drift, f'drifts by {slope:.2%}: its lag is {start:.2f} s at first and '
         f'{start + drift:.2f} s at the end', None, lambda t: start + slope * (t - at[0])))
    rests = [np.abs(lags - late(at)).sum() for *_, late in models]
    change, *result = models[int(np.argmin(rests))]
    if abs(change) > least \
            and usual - min(rests) > shipped().prior * max(min(rests) / n, least / 10):
        return result
    if allowed[0] <= middle <= allowed[1]:
        return None
    return [f'is {abs(middle):.2f} s {"behind" if middle > 0 else "ahead"}, expected '
            f'{allowed[0]:g} to {allowed[1]:g} s', None, lambda t: np.full(len(t), middle)]


def window_lags(t: np.ndarray, late: np.ndarray, early: np.ndarray, gaps: np.ndarray
                ) -> tuple[np.ndarray, np.ndarray]:
    """
    Time shifts between two similar series, by windows.

    Args:
        t: (N,) times [s].
        late: (N,) delayed magnitude.
        early: (N,) leading magnitude.
        gaps: (N,) mask of times in a gap, whose windows are ignored.

    Returns:
        times (W,) of the motion in these windows [s], and shifts (W,) [s].

    """
    limits, period, at, lags = shipped(), float(t[1] - t[0]), [-np.inf], list[float]()
    length, reach, apart = (round(x / period) for x in (
        limits.window, limits.lag_reach, 1 / limits.edge))
    for first in range(0, len(t) - length + 1, length // OVERLAP):
        part, begin = slice(first, first + length), max(0, first - reach)
        own = late[part] - late[part].mean()
        views = np.lib.stride_tricks.sliding_window_view(early[begin:part.stop + reach], length)
        views = views - views.mean(axis=1, keepdims=True)
        alike = views @ own / (np.sqrt((views**2).sum(axis=1) * (own**2).sum()) + 1e-12)
        k = int(np.argmax(alike))
        # Evidence against no correlation, or against the best distant shift.
        other = alike[np.abs(np.arange(len(alike)) - k) > apart].max(initial=0.0)
        evidence = 0.5 * limits.edge * limits.window * np.log(
            (1 - other**2) / (1 - min(alike[k], 1 - 1e-9)**2))
        moment = np.average(t[part], weights=own**2)
        if evidence > limits.prior and 0 < k < len(alike) - 1 and not gaps[part].any() \
                and moment > at[-1] + limits.window / OVERLAP:
            a, b, c = alike[k - 1:k + 2]
            at.append(moment)
            lags.append(period * (first - begin - k - 0.5 * (a - c) / min(a - 2 * b + c, -1e-12)))
    return np.array(at[1:]), np.array(lags)
