"""
Checks of stamps: order, times of recording, and comparison of topics.

The age of a message is its time of recording minus its stamp. Computer load increases the age of
all topics, so each age is compared with the median age of the other topics at that time.
"""

import numpy as np

from beetle_omni_ros.identify.gap.bags import NEEDED, Recording
from beetle_omni_ros.identify.recording.damage import changed, Damage
from beetle_omni_ros.identify.recording.limits import RecordingLimits

LEAST_BINS = 8
FACTORS = {1e-9: 'nanoseconds', 1e-6: 'microseconds', 1e-3: 'milliseconds'}
NORMAL = 1.4826         # standard deviation over median absolute deviation
MOMENT = 1e-6           # [s] below which stamps are equal
FOLLOWING = 8           # stamps that must continue after a step of the clock


def clock_damages(recording: Recording, limits: RecordingLimits) -> list[Damage]:
    """Damages by stamps alone, at most one for each topic."""
    found = {}
    for topic in NEEDED:
        for check in (_advance, _order, _repeats):
            damage = check(recording, topic, limits)
            if damage:
                found[topic] = damage
                break
    ages = Ages(recording, limits)
    for topic in NEEDED:
        damage = ages.damage(topic)
        # Ages determine a step better than the order of stamps does, but not a wrong unit.
        if damage and (topic not in found or 'goes back' in found[topic].cause):
            found[topic] = damage
    return list(found.values())


def begin_of(recording: Recording) -> float:
    """First stamp of the IMU [s], the origin of stated times."""
    t = recording.times['imu/data_raw']
    return float(t[0]) if len(t) else 0.0


def _damage(recording, topic, cause, at=None, **more):
    moment = None if at is None else max(0.0, float(at) - begin_of(recording))
    return Damage(recording.name, topic, cause, moment, **more)


def _advance(recording, topic, limits):
    """Stamps that do not advance, or are in another unit."""
    t = recording.times[topic]
    steps = np.diff(t)
    ahead = steps[steps > 0]
    period = float(np.median(ahead)) if len(ahead) else 0.0
    if len(ahead) < 0.05 * len(t):
        value = f'{t[0]:.3f}'
        return _damage(recording, topic, f'{len(t) - len(ahead)} of {len(t)} stamps do not '
                       f'advance (first stamp {value} s)')
    if limits.shortest_period <= period <= limits.longest_period:
        return None
    cause = (f'stamps are {period:g} s apart; expected {limits.shortest_period:g} to '
             f'{limits.longest_period:g} s')
    received = recording.received.get(topic)
    if received is not None and len(received) > 1 and np.median(np.diff(received)) > 0:
        factor = float(np.median(np.diff(received)) / period)
        unit = min(FACTORS, key=lambda f: abs(np.log(factor / f)))
        if 0.5 < factor / unit < 2:
            cause += f': {FACTORS[unit]} taken for seconds?'
    return _damage(recording, topic, cause)


def _order(recording, topic, limits):
    """Stamps that go back: a clock that was set, or messages out of order."""
    t = recording.times[topic]
    steps = np.diff(t)
    back = np.flatnonzero(steps < -MOMENT)
    if not len(back):
        return None
    period = float(np.median(steps[steps > 0]))
    for k in back:
        size = -float(steps[k])
        after = t[k + 1:k + 1 + FOLLOWING]
        goes_on = len(after) > 1 and (np.diff(after) > 0).all() and (after < t[k]).sum() > 0
        if size > 3 * period and goes_on and len(back) <= 5:
            return _damage(recording, topic, f'the clock goes back by {size:.2f} s', t[k])
    if len(back) > limits.disordered * len(t):
        order = np.argsort(t, kind='stable')
        return _damage(
            recording, topic, f'{len(back)} of {len(t)} messages are out of order by up to '
            f'{-steps.min():.3f} s: several sources on one topic, or a transport that reorders',
            t[back[0]], fix='sort the messages by stamp',
            repair=lambda r: changed(r, topic, keep=order))
    return None


def _repeats(recording, topic, limits):
    """Messages that were recorded twice, or two sources with the same stamps."""
    t, values = recording.times[topic], recording.values[topic]
    order = np.argsort(t, kind='stable')
    same = np.diff(t[order]) <= MOMENT
    if same.sum() <= limits.repeated_stamps * len(t):
        return None
    first = float(t[order][:-1][same][0])
    rows = values[order]
    equal = np.isclose(rows[1:], rows[:-1], rtol=0, atol=1e-12, equal_nan=True).all(axis=1)
    if equal[same].mean() > 0.95:
        keep = order[np.concatenate([[True], ~same])]
        return _damage(recording, topic, f'{int(same.sum())} of {len(t)} stamps occur twice with '
                       'the same values: messages were recorded twice', first,
                       fix='keep each message once',
                       repair=lambda r: changed(r, topic, keep=keep))
    return _damage(recording, topic, f'{int(same.sum())} of {len(t)} stamps occur twice with '
                   'other values: two sources publish on one topic', first)


class Ages:
    """
    Ages of all topics relative to each other over the time of recording.

    Args:
        recording: recording with times of recording; without them no damage is found.
        limits: limits of a valid recording.

    """

    def __init__(self, recording: Recording, limits: RecordingLimits):
        self.recording, self.limits, self.medians = recording, limits, {}
        known = {topic: recording.received[topic] for topic in NEEDED
                 if len(recording.received.get(topic, ())) == len(recording.times[topic]) > 1}
        if len(known) < 3:
            return
        begin = max(float(np.min(r)) for r in known.values())
        end = min(float(np.max(r)) for r in known.values())
        count = int((end - begin) / limits.clock_bin)
        if count < LEAST_BINS:
            return
        self.edges = begin + limits.clock_bin * np.arange(count + 1)
        for topic, received in known.items():
            age = received - recording.times[topic]
            place = np.searchsorted(self.edges, received, side='right') - 1
            order = np.argsort(place, kind='stable')
            cuts = np.searchsorted(place[order], np.arange(count + 1))
            self.medians[topic] = np.array([
                np.median(age[order[a:b]]) if b > a else np.nan
                for a, b in zip(cuts[:-1], cuts[1:], strict=True)])

    def relative(self, topic: str) -> np.ndarray:
        """(bins,) age of a topic minus the median age of the others [s]."""
        others = np.array([m for name, m in self.medians.items() if name != topic])
        with np.errstate(all='ignore'):
            return self.medians[topic] - np.nanmedian(others, axis=0)

    def damage(self, topic: str) -> Damage | None:
        """Offset, step or drift of a topic's clock."""
        if topic not in self.medians:
            return None
        limits, age = self.limits, self.relative(topic)
        good = np.isfinite(age)
        if good.sum() < LEAST_BINS:
            return None
        at, age = self.edges[:-1][good], age[good]
        split, before, after, noise = change_point(age)
        step = after - before
        if abs(step) > max(limits.clock_step, limits.clock_noise * noise):
            return self._step(topic, at, split, step)
        line = np.polyfit(at - at[0], age, 1)
        drift = line[0] * (at[-1] - at[0])
        rest = age - np.polyval(line, at - at[0])
        noise = NORMAL * float(np.median(np.abs(rest)))
        if abs(drift) > max(limits.clock_step, limits.clock_noise * noise):
            return self._drift(topic, at, line)
        offset = float(np.median(age))
        if abs(offset) > limits.clock_offset:
            word = 'behind' if offset > 0 else 'ahead of'
            return self._named(topic, f'stamps are {abs(offset):.2f} s {word} those of the other '
                               'topics that were recorded at the same time: the clocks of two '
                               'computers differ, or another time base', None,
                               lambda r: changed(r, topic, times=r.times[topic] + offset),
                               f'shift the stamps by {offset:.3f} s')
        return None

    def _drift(self, topic, at, line):
        rate = float(line[0])
        word = 'slow' if rate > 0 else 'fast'
        return self._named(
            topic, f'the clock drifts: it runs {abs(rate):.2%} too {word} against the other '
            f'topics, {abs(rate) * (at[-1] - at[0]):.2f} s in this recording', None,
            lambda r: changed(r, topic, times=r.times[topic] + np.polyval(
                line, r.received[topic] - at[0])), 'take the drift out of the stamps')

    def _step(self, topic, at, split, step):
        stamps, received = self.recording.times[topic], self.recording.received[topic]
        near = np.flatnonzero(np.abs(received - at[min(split, len(at) - 1)])
                              < 3 * self.limits.clock_bin)
        own = np.abs(np.diff(received[near] - stamps[near]))
        onset = int(near[np.argmax(own)]) + 1 if len(own) else int(np.searchsorted(
            received, at[split]))
        word = 'back' if step > 0 else 'forward'
        parts = np.arange(len(stamps)) >= onset
        return self._named(
            topic, f'the clock steps {word} by {abs(step):.2f} s against the other topics',
            stamps[onset - 1],
            lambda r: changed(r, topic, times=r.times[topic] + step * parts),
            f'shift later stamps by {step:.3f} s')

    def _named(self, topic, cause, at, repair, fix):
        return _damage(self.recording, topic, cause, at, fix=fix, repair=repair)


def change_point(values: np.ndarray) -> tuple[int, float, float, float]:
    """
    Find the best single step in finite values (n,).

    Returns:
        index of the first value after the step, medians before and after it, standard deviation
        about these.

    """
    n = len(values)
    total, counts = np.cumsum(values - values.mean()), np.arange(1, n)
    # Largest difference of means, weighted by their numbers of values.
    score = total[:-1]**2 * (1 / counts + 1 / (n - counts))
    inner = slice(1, n - 2) if n > 4 else slice(0, n - 1)
    split = int(np.argmax(score[inner])) + 1 + (inner.start or 0)
    before, after = float(np.median(values[:split])), float(np.median(values[split:]))
    rest = np.concatenate([values[:split] - before, values[split:] - after])
    return split, before, after, NORMAL * float(np.median(np.abs(rest)))
