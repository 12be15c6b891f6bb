"""Verdict, reason and next experiment of an analysis."""

from __future__ import annotations

from typing import TYPE_CHECKING

from beetle_omni_ros.identify.gap.candidates import CLOSED_LOOP_BIAS, NOT_CONFIRMED, TOO_SMALL
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.patterns import SWINGING
from beetle_omni_ros.robot.effects import CATALOGUE, separating_experiment

if TYPE_CHECKING:
    from beetle_omni_ros.identify.gap.analysis import Analysis


def hidden(a: Analysis, p: GapParameters) -> list[str]:
    """
    Names of entries that these data could not show at a typical size.

    Entries of a special regime, such as the ground effect, are not included; see :func:`not_met`.
    """
    return [name for name in _undetectable(a, p) if not CATALOGUE[name].one_regime]


def not_met(a: Analysis, p: GapParameters) -> list[str]:
    """Names of undetectable entries that act in one regime only."""
    return [name for name in _undetectable(a, p) if CATALOGUE[name].one_regime]


def _undetectable(a, p):
    best: dict[str, float] = {}
    for label, seen in a.detectability.items():
        name = label.partition(' ')[0].partition('[')[0]
        best[name] = max(best.get(name, 0.0), seen.sigma)
    return [name for name, sigma in best.items() if sigma < p.decidable]


def decide(a: Analysis, p: GapParameters) -> None:
    """Set verdict, reason, partial effects and next experiment."""
    found, count = a.found, len(a.fit.time)
    before, after, floor = found.cost
    # The fit of all keys also fits noise: one unit of chi2 for each key without prior.
    floor += sum(name not in a.fit.priors for name in found.state.names)
    # An irrelevant size, a gust and closed-loop bias are not unknown effects, even with a large
    # gain.
    small = max((t.gain for t in found.trials.values()
                 if t.reason in (TOO_SMALL, NOT_CONFIRMED, CLOSED_LOOP_BIAS)), default=0.0)
    left = max(after - floor - small, 0.0)
    explained = (before - after) / max(before - after + left, 1e-9)
    undetectable = hidden(a, p)
    seen = {label.partition(' ')[0].partition('[')[0] for label in a.detectability}
    share = len(undetectable) / max(sum(not CATALOGUE[name].one_regime for name in seen), 1)
    repeatable = _repeatable(a.remainder, p)
    unmodelled = _unmodelled_force(a, before - after, p)
    sets = [[t, *found.rivals.get(t.candidate.label, [])] for t in found.accepted]
    names = [len({t.candidate.name for t in members}) for members in sets]
    forces = [t for t in found.accepted if t.candidate.acts_on_body_only(a.keys)]
    if found.low_excitation and (forces or not found.accepted):
        a.verdict, a.partial = 'not_decidable', forces
        a.reason = _low_excitation_reason(sets, forces, undetectable)
        found.accepted[:] = [t for t in found.accepted if t not in forces]
    elif found.accepted:
        part = a.remainder.gain / max(before - after, 1e-9)
        if left > p.least_left and explained < p.enough or unmodelled \
                or repeatable and part > p.remainder_share or a.above_ceiling:
            a.verdict, a.partial = 'unknown', list(found.accepted)
            rest = unmodelled or (a.above_ceiling[0].text if a.above_ceiling else a.remainder.text)
            known = ', '.join(dict.fromkeys(t.candidate.name for t in found.accepted))
            a.reason = (f'{rest}, even with {known} ({explained:.0%} of what all known effects '
                        'could explain)')
            found.accepted.clear()
        elif max(names) >= p.crowd or (share > p.most_hidden and max(names) > 1):
            a.verdict = 'not_decidable'
            a.reason = f'these flights do not separate {max(names)} explanations'
        else:
            a.verdict = 'named_set' if max(names) > 1 else 'named'
            a.reason = f'explains {explained:.1%} of what all known effects could explain'
    elif a.above_ceiling:
        a.verdict = 'unknown'
        a.reason = f'{a.above_ceiling[0].text}, and no known effect explains it'
    elif repeatable or unmodelled or left > 0.05 * count:
        a.verdict, a.reason = 'unknown', unmodelled or a.remainder.text
    elif share > p.most_hidden:
        a.verdict = 'not_decidable'
        a.reason = (f'{len(undetectable)} known effects of typical size would not be detected in '
                    'these flights')
    else:
        a.verdict, a.reason = 'no_gap', 'the residual is noise and manufacturing tolerance'
    a.experiment = _experiment(a, sets if found.accepted or forces else [], undetectable)


def disagreement(a: Analysis, gap: float) -> None:
    """Replace "no gap" by "unknown" if free runs have a large error (``gap`` noise floors)."""
    if a.verdict != 'no_gap':
        return
    if not gap <= a.fit.p.agreement:
        a.verdict = 'unknown'
        a.reason = (f'the error of free runs is {gap:.2f} noise floors, and no known effect '
                    f'explains it; flights without a gap have at most {a.fit.p.agreement:g}')
        a.experiment = _experiment(a, [], [])


def withdraw(a: Analysis, gap: dict[str, float], why: str) -> None:
    """
    Withdraw effects that the free runs refute.

    ``gap`` has the errors 'before' and 'after' in noise floors. ``why`` is the end of a sentence.
    """
    names = ' and '.join(t.candidate.name for t in a.accepted)
    a.verdict, a.partial = 'unknown', list(a.found.accepted)
    a.reason = (f'{names} would explain the fitted flights and {why}: error of free runs '
                f'{gap["before"]:.2f} before, {gap["after"]:.2f} after, in noise floors')
    a.found.accepted.clear()
    a.experiment = _experiment(a, [], [])


def _low_excitation_reason(sets, forces, undetectable):
    """Why a flight with low excitation determines no forces."""
    seen = sorted({t.candidate.name for members in sets if members[0] in forces
                   for t in members})
    found = f'{" or ".join(seen)} and other effects would explain the residual' if seen else \
        f'{len(undetectable)} known effects of typical size would not be detected'
    return f'the excitation is low, the motion is mostly a reaction to disturbances; {found}'


def _unmodelled_force(a, explained, p):
    """Description of a force that no entry can cause; '' if there is none."""
    line = a.spectral_line
    if line.ratio > p.least_line and line.size > p.least_force:
        return (f'a periodic force of {line.frequency:.2f} Hz and {line.size:.2f} m/s^2 RMS, '
                'which depends on no state')
    for pattern in a.patterns:
        force, torque = pattern.size
        swings = pattern.text == SWINGING and force > p.swinging_force
        large = swings or force > p.least_force or torque > p.least_torque
        share = 0.0 if swings else p.pattern_share
        if pattern.agrees(p) and large and pattern.gain > max(p.least_pattern, share * explained):
            return (f'a force that correlates with {pattern.text} ({force:.2f} m/s^2, '
                    f'{torque:.2f} rad/s^2 RMS; gain on held-out data: {pattern.gain:.0f} of '
                    'chi2)')
    return ''


def _repeatable(rest, p):
    """Whether the residual is repeatable and larger than tolerances explain."""
    limits = {'force': p.least_force, 'torque': p.least_torque, 'joint': p.least_joint}
    large = [name for name, gain in rest.channels if gain > p.least_channel
             and rest.size[name] > limits[name.partition('_')[0]]]
    return rest.gain > p.least_remainder and rest.positive >= 0.7 and bool(large)


def _experiment(a, sets, undetectable):
    if a.verdict == 'not_decidable' and a.found.low_excitation:
        own = [CATALOGUE[name].separated_by for name in dict.fromkeys(
            t.candidate.name for members in sets for t in members)]
        return '; '.join(['60 s of poses with large turns, tilts and translation', *own[:3]])
    if a.verdict in ('named_set', 'not_decidable') and sets:
        members = max(sets, key=len)
        others = sorted({t.candidate.name for t in members[1:]})
        return (f'{separating_experiment([t.candidate.name for t in members])} (separates '
                f'{members[0].candidate.name} from {", ".join(others) or "the rest"})')
    if a.verdict == 'not_decidable':
        flights = list(dict.fromkeys(CATALOGUE[name].excited_by for name in undetectable))
        tests = list(dict.fromkeys(CATALOGUE[name].separated_by for name in undetectable))
        return (f'poses with large turns, tilts and translation ({"; ".join(flights[:5])}); '
                f'best: {"; ".join(tests[:3])}')
    if a.verdict == 'unknown':
        return 'the same task three times: errors that repeat are of the model, others are gusts'
    return None
