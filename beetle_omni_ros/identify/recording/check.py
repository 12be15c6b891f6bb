"""All checks of one recording, and repairs."""

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.recording.bag import changed, Damage, NEEDED, Recording
from beetle_omni_ros.identify.recording.parameters import shipped
from beetle_omni_ros.identify.recording.relations import (
    COMMAND,
    Mistake,
    mistakes,
    Relation,
    RELATIONS,
    signals_of,
    Smoothed,
)
from beetle_omni_ros.identify.recording.series import low_pass
from beetle_omni_ros.identify.recording.topics import (
    clock_damages,
    lag_damage,
    reading_damages,
    sensor_damages,
)
from beetle_omni_ros.model.parameters import RobotParameters

MOST_REPAIRS = 6        # successive; a repair can reveal another damage


def checked(recording: Recording, robot: RobotParameters, begin: float, fix: bool = False
            ) -> tuple[Recording, list[str], list[Damage]]:
    """
    Check the flown part of a recording with every topic of ``NEEDED`` by redundant signals.

    Of the robot file, only geometry, mass and rotor lag are used.

    Args:
        recording: the flown part.
        robot: robot file.
        begin: first stamp of the whole recording's IMU [s], the origin of stated times.
        fix: whether certain corrections are applied until none is left.

    Returns:
        recording, descriptions of the corrections, and damages that are left: of the most
        fundamental kind only, because jumping values and wrong clocks hide wrong units and axes.

    """
    done: list[str] = []
    while True:
        with np.errstate(all='ignore'):
            found = [replace(d, at_s=None if d.at_s is None else max(0.0, float(d.at_s) - begin))
                     for d in _damages(recording, robot)]
        certain = [(d, d.repair) for d in found if d.repair and fix]
        if not certain or len(done) == MOST_REPAIRS:
            return recording, done, found
        damage, repair = certain[0]
        recording = repair(recording)
        done.append(f'{damage.text}; corrected: {damage.fix}')


def _damages(recording, robot):
    if min(len(recording.times[topic]) for topic in NEEDED) < 2:
        return []
    found = clock_damages(recording)
    found += reading_damages(recording, {damage.topic for damage in found})
    signals = None if found else signals_of(recording, robot)
    if signals is None:
        return found or sensor_damages(recording)
    found = [damage for relation in RELATIONS.values() if relation.lag
             if (damage := lag_damage(recording.name, relation, signals))]
    comparison = Comparison(recording.name, signals)
    return found or comparison.explained() or sensor_damages(recording) or comparison.unexplained()


@dataclass
class Agreement:
    """
    How two signals agree, below the edge of the comparison.

    Attributes:
        late, early: (N, n) both signals.
        noise: largest variance of their difference by sensor noise.

    """

    late: np.ndarray
    early: np.ndarray
    noise: float

    @property
    def error(self) -> np.ndarray:
        """(N, n) squared difference."""
        return (self.late - self.early)**2

    def size(self, part: slice = slice(None)) -> np.ndarray:
        """(n,) mean of the sum of both squares."""
        return (self.late[part]**2 + self.early[part]**2).mean(axis=0) + 1e-12

    def unlike(self, part: slice = slice(None)) -> np.ndarray:
        """(n,) errors of columns beyond noise, over their size there or in the flight: 0 to 2."""
        return np.maximum(self.error[part].mean(axis=0) - self.noise, 0) / np.maximum(
            self.size(part), self.size())

    def has_gain(self, most: float) -> bool:
        """Whether one signal is larger by more than a factor."""
        ratio = (self.late * self.early).sum() / ((self.early**2).sum() + 1e-12)
        return bool(self.size().mean() > 4 * self.noise and not 1 / most < ratio < most)

    def since(self, k: int, other: 'Agreement', margin: int) -> 'Agreement':
        """This one before sample ``k``, another from it on, none where a filter mixes them."""
        late, early = (np.concatenate([a[:k], b[k:]]) for a, b in (
            (self.late, other.late), (self.early, other.early)))
        late[max(0, k - margin):k + margin] = early[max(0, k - margin):k + margin] = 0.0
        return Agreement(late, early, max(self.noise, other.noise))


@dataclass
class Hypothesis:
    """
    One mistake in a recording, or none.

    Attributes:
        agreements: of all relations, without the mistake.
        score: log likelihood of Gaussian errors of unknown size, plus log prior.
        mistake: the mistake, or None.
        onset: index of the first sample with the mistake.

    """

    agreements: dict[str, Agreement]
    score: float
    mistake: Mistake | None = None
    onset: int = 0


class Comparison:
    """
    The relations of one flight, with all mistakes that contradictions suggest.

    Args:
        name: name of the recording.
        signals: its signals.

    """

    def __init__(self, name: str, signals: Smoothed):
        self.name, self.signals, self.limits = name, signals, (limits := shipped())
        period = float(np.diff(signals.t[:2])[0])
        self.kernel = low_pass(limits.edge, 2, period)
        self.centres = self.kernel.centres(len(signals.t))
        near = np.convolve(signals.silent, np.ones(len(self.kernel.taps)), 'same') > 0.5
        self.fine = ~near[self.centres]
        self.t = signals.t[self.centres][self.fine]
        self.window = round(limits.window / (2 * period))
        self.parts = [slice(None), *(slice(k, k + self.window) for k in range(
            0, len(self.t) - self.window + 1, self.window))]
        self.usual = self._judged({name: self._agreement(relation, signals)
                                   for name, relation in RELATIONS.items()})
        wrong = [name for name in RELATIONS if self._contradicts(name, self.usual)]
        # A contradiction of thrusts may follow from another one.
        self.wrong = [name for name in wrong if RELATIONS[name].certain] or wrong

    def _agreement(self, relation: Relation, signals: Smoothed) -> Agreement:
        late, early = (self.kernel(x)[:len(self.centres)][self.fine]
                       for x in relation.pair(signals))
        edge = self.limits.edge     # below it, white noise has this variance after derivatives
        return Agreement(late, early, self.limits.noise**2 * sum(
            float(signals.noise[topic][k]) * 2 * (2 * np.pi)**(2 * order)
            * edge**(2 * order + 1) / (2 * order + 1) for topic, k, order in relation.noise))

    def _judged(self, agreements, mistake=None, onset=0):
        # Below the edge, twice as many samples are independent in white noise; errors are not.
        count = 0.5 * self.limits.edge * len(self.t) * 2 * self.kernel.period
        score = -self.limits.prior * ((mistake is not None) + (onset > 0)) - count * sum(
            np.log(a.error.mean(axis=0) / a.size() + 1e-6).sum() for a in agreements.values())
        return Hypothesis(agreements, float(score), mistake, onset)

    def _contradicts(self, name: str, h: Hypothesis) -> bool:
        """Whether a relation does not hold."""
        a, left, relation = h.agreements[name], 1 - self.limits.agreement, RELATIONS[name]
        gain = a.has_gain(getattr(self.limits, relation.gain))
        if relation.certain:
            return gain or any((a.unlike(part) > left).any() for part in self.parts)
        if h.mistake is None:       # each improvement by a mistake counts
            return bool(a.unlike().any())
        return gain or a.error.sum() > left * self.usual.agreements[name].error.sum()

    def explained(self) -> list[Damage]:
        """The most likely mistake, if it resolves a contradiction and makes no other one."""
        tried = [self._with(mistake) for mistake in mistakes() if set(self.wrong) & set(
            [name for name in mistake.touches if RELATIONS[name].certain] or mistake.touches)]
        # A sensor can turn on the way; what a command means does not change during a flight.
        tried += [late for h in tried if h.mistake.topic != COMMAND and (late := self._since(h))]
        best = max([self.usual, *tried], key=lambda h: h.score)
        if best.mistake is None or not any(
                name in best.mistake.touches and not self._contradicts(name, best)
                for name in self.wrong) or any(
                self._contradicts(name, best) for name in best.mistake.touches
                if RELATIONS[name].certain and name not in self.wrong):
            return []
        weights = np.exp([h.score - best.score for h in [self.usual, *tried]])
        # Some cause that is not listed has the odds of one more mistake.
        sure = float(1 / (weights.sum() + np.exp(-self.limits.prior)))
        return [self._damage(best.mistake, best.onset, sure)]

    def _with(self, mistake):
        signals = self.signals.corrected(mistake.part or mistake.topic, mistake.undo)
        return self._judged(self.usual.agreements | {
            name: self._agreement(RELATIONS[name], signals) for name in mistake.touches}, mistake)

    def _since(self, h):
        """The same mistake from the most likely moment on, a window from both ends; or None."""
        usual = self.usual.agreements
        gain = sum(((usual[name].error - h.agreements[name].error) / usual[name].size()).sum(
            axis=1) for name in h.mistake.touches)
        after = np.cumsum(gain[::-1])[::-1][self.window:-self.window]
        if not len(after):
            return None
        k = self.window + int(np.argmax(after))
        return self._judged({name: usual[name].since(k, a, self.kernel.margin // 2)
                             for name, a in h.agreements.items()}, h.mistake, k)

    def _damage(self, mistake, onset, sure):
        fix = repair = None
        if mistake.fix and not onset and sure >= self.limits.certain:
            fix = mistake.fix
            repair = lambda r: changed(     # noqa: E731
                r, mistake.topic, values=r.values[mistake.topic] @ mistake.undo.T)
        return Damage(self.name, mistake.topic, mistake.text,
                      self.t[onset] if onset else None, sure, fix, repair)

    def unexplained(self) -> list[Damage]:
        """Contradictions that no known mistake explains."""
        return [Damage(
            self.name, RELATIONS[name].late, f'{RELATIONS[name].words} contradict each other '
            f'under every convention that was tried: they leave {min(a.unlike().max(), 1.0):.0%} '
            'unexplained, or their ratio is wrong: sensor, range, or another flight')
            for name, a in self.usual.agreements.items()
            if name in self.wrong and RELATIONS[name].certain]
