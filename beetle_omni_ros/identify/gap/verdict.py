"""What to say of an analysis: a name, a set, unknown, not decidable, or no gap; and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from beetle_omni_ros.identify.gap.candidates import FOUGHT, NOT_HELD, TOO_SMALL
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.patterns import SWINGING
from beetle_omni_ros.robot.effects import CATALOGUE, separating_experiment

if TYPE_CHECKING:
    from beetle_omni_ros.identify.gap.analysis import Analysis


def hidden(a: Analysis, p: GapParameters) -> list[str]:
    """
    Names of entries of which these data could not show a realistic size.

    Without those that act in one regime alone, near the ground say; see :func:`not_met`.
    """
    return [name for name in _out_of_sight(a, p) if not CATALOGUE[name].one_regime]


def not_met(a: Analysis, p: GapParameters) -> list[str]:
    """Names of entries whose regime these flights did not meet, and so could not show."""
    return [name for name in _out_of_sight(a, p) if CATALOGUE[name].one_regime]


def _out_of_sight(a, p):
    best: dict[str, float] = {}
    for label, seen in a.visible.items():
        name = label.partition(' ')[0].partition('[')[0]
        best[name] = max(best.get(name, 0.0), seen.sigma)
    return [name for name, sigma in best.items() if sigma < p.decidable]


def decide(a: Analysis, p: GapParameters) -> None:
    """Set verdict, reason, what explains only a part, and what to fly next."""
    found, count = a.found, len(a.fit.time)
    before, after, floor = found.cost
    # Everything at once also fits some noise: a chi2 of one for each number without a belief.
    floor += sum(name not in a.fit.beliefs for name in found.state.names)
    # A latency of a millisecond is no unknown, however clearly it shows; nor is a gust, which
    # differs from flight to flight, or the answers to it.
    small = max((t.gain for t in found.trials.values()
                 if t.reason in (TOO_SMALL, NOT_HELD, FOUGHT)), default=0.0)
    left = max(after - floor - small, 0.0)
    explained = (before - after) / max(before - after + left, 1e-9)
    out_of_sight = hidden(a, p)
    seen = {label.partition(' ')[0].partition('[')[0] for label in a.visible}
    share = len(out_of_sight) / max(sum(not CATALOGUE[name].one_regime for name in seen), 1)
    repeats = _repeats(a.rest, p)
    strange = _strange(a, before - after, p)
    sets = [[t, *found.rivals.get(t.candidate.label, [])] for t in found.accepted]
    names = [len({t.candidate.name for t in members}) for members in sets]
    pushed = [t for t in found.accepted if t.candidate.pushes(a.keys)]
    if found.still and (pushed or not found.accepted):
        a.verdict, a.partial = 'not_decidable', pushed
        a.reason = _stillness(sets, pushed, out_of_sight)
        found.accepted[:] = [t for t in found.accepted if t not in pushed]
    elif found.accepted:
        part = a.rest.gain / max(before - after, 1e-9)
        if left > p.least_left and explained < p.enough or strange \
                or repeats and part > p.remainder_share or a.loud:
            a.verdict, a.partial = 'unknown', list(found.accepted)
            rest = strange or (a.loud[0].text if a.loud else a.rest.text)
            known = ', '.join(dict.fromkeys(t.candidate.name for t in found.accepted))
            a.reason = (f'{rest}, also with {known} ({explained:.0%} of what known effects could '
                        'explain)')
            found.accepted.clear()
        elif max(names) >= p.crowd or (share > p.most_hidden and max(names) > 1):
            a.verdict = 'not_decidable'
            a.reason = f'these flights cannot tell {max(names)} explanations apart'
        else:
            a.verdict = 'named_set' if max(names) > 1 else 'named'
            a.reason = f'explains {explained:.1%} of what known effects could explain'
    elif a.loud:
        a.verdict, a.reason = 'unknown', f'{a.loud[0].text}, and no known effect explains it'
    elif repeats or strange or left > 0.05 * count:
        a.verdict, a.reason = 'unknown', strange or a.rest.text
    elif share > p.most_hidden:
        a.verdict = 'not_decidable'
        a.reason = (f'{len(out_of_sight)} known effects of realistic size would not show in '
                    'these flights')
    else:
        a.verdict, a.reason = 'no_gap', 'what is left is noise and manufacturing tolerance'
    a.experiment = _experiment(a, sets if found.accepted or pushed else [], out_of_sight)


def disagreement(a: Analysis, gap: float) -> None:
    """
    Take "no gap" back where free runs or a channel are farther off than noise may be.

    Args:
        a: decided, with its free runs.
        gap: of the flights that judge, in noise floors.

    """
    if a.verdict != 'no_gap':
        return
    if not gap <= a.fit.p.agreement:
        a.verdict = 'unknown'
        a.reason = (f'free runs are {gap:.2f} noise floors off, and no known effect explains it; '
                    f'flights without a gap have at most {a.fit.p.agreement:g}')
        a.experiment = _experiment(a, [], [])


def withdraw(a: Analysis, gap: dict[str, float], why: str) -> None:
    """
    Take back what flights that judge speak against.

    Such a model is not to be flown with, and such an effect is not what differs.

    Args:
        a: decided, with something named.
        gap: 'before' and 'after' of the flights that judge, in noise floors.
        why: what the effects do to those flights.

    """
    names = ' and '.join(t.candidate.name for t in a.accepted)
    a.verdict, a.partial = 'unknown', list(a.found.accepted)
    a.reason = (f'{names} would explain the fitted flights and {why}: '
                f'{gap["before"]:.2f} to {gap["after"]:.2f} noise floors in free runs')
    a.found.accepted.clear()
    a.experiment = _experiment(a, [], [])


def _stillness(sets, pushed, out_of_sight):
    """Why a flight that hardly moves decides nothing about forces."""
    seen = sorted({t.candidate.name for members in sets if members[0] in pushed
                   for t in members})
    found = f'; {" or ".join(seen)} would explain it, and others as well' if seen else \
        f'; {len(out_of_sight)} known effects of realistic size would not show'
    return 'the robot hardly moves but where it is pushed' + found


def _strange(a, explained, p):
    """What no entry can be and these flights show all the same, in words; '' if nothing."""
    line = a.rhythm
    if line.ratio > p.least_line and line.size > p.least_force:
        return (f'a force with a rhythm of its own, {line.frequency:.2f} Hz and '
                f'{line.size:.2f} m/s^2, which goes with no state')
    for pattern in a.patterns:
        force, torque = pattern.size
        swings = pattern.text == SWINGING and force > p.swinging_force
        large = swings or force > p.least_force or torque > p.least_torque
        share = 0.0 if swings else p.pattern_share
        if pattern.agrees(p) and large and pattern.gain > max(p.least_pattern, share * explained):
            return (f'a force that goes with {pattern.text} ({force:.2f} m/s^2, {torque:.2f} '
                    f'rad/s^2); it gains {pattern.gain:.0f} of chi2 on data left out')
    return ''


def _repeats(rest, p):
    """Whether what is left repeats, and is more than tolerances leave behind."""
    limits = {'force': p.least_force, 'torque': p.least_torque, 'joint': p.least_joint}
    large = [name for name, gain in rest.channels if gain > p.least_channel
             and rest.size[name] > limits[name.partition('_')[0]]]
    return rest.gain > p.least_remainder and rest.positive >= 0.7 and bool(large)


def _experiment(a, sets, out_of_sight):
    if a.verdict == 'not_decidable' and a.found.still:
        own = [CATALOGUE[name].separated_by for name in dict.fromkeys(
            t.candidate.name for members in sets for t in members)]
        return '; '.join(['60 s of poses with large turns, tilts and translation', *own[:3]])
    if a.verdict in ('named_set', 'not_decidable') and sets:
        members = max(sets, key=len)
        others = sorted({t.candidate.name for t in members[1:]})
        return (f'{separating_experiment([t.candidate.name for t in members])} (separates '
                f'{members[0].candidate.name} from {", ".join(others) or "the rest"})')
    if a.verdict == 'not_decidable':
        flights = list(dict.fromkeys(CATALOGUE[name].excited_by for name in out_of_sight))
        tests = list(dict.fromkeys(CATALOGUE[name].separated_by for name in out_of_sight))
        return (f'poses with large turns, tilts and translation ({"; ".join(flights[:5])}); '
                f'best: {"; ".join(tests[:3])}')
    if a.verdict == 'unknown':
        return 'the same task three times over: what repeats is model, the rest is gusts'
    return None
