"""Gap analysis of the joint layer alone, from a response log of the servos."""

from pathlib import Path

import matplotlib
import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.gap.joint_changes import change_grids, changes, sentences
from beetle_omni_ros.identify.gap.joint_search import Entry, Found, Search, Trial
from beetle_omni_ros.identify.gap.keys import friction
from beetle_omni_ros.identify.gap.page import AFTER, BEFORE, head
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.results import grids, summary
from beetle_omni_ros.identify.joint import identify_joints
from beetle_omni_ros.identify.joint_log import JointLog, read_joint_log
from beetle_omni_ros.identify.joint_results import joint_page, joint_results
from beetle_omni_ros.identify.joint_servos import file_servos
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_model import simulate
from beetle_omni_ros.pages.figures import legend, line, panels, STYLE, svg
from beetle_omni_ros.robot.effects import CATALOGUE, separating_experiment
from beetle_omni_ros.robot.parameters import RobotParameters


def analyse_joint_log(runs: list[Path], holdout: list[Path], robot: RobotParameters,
                      base: Path | None, p: GapParameters | None = None) -> tuple[dict, str]:
    """
    Analyse the first log, and compare it with further ones and with those of ``holdout``.

    ``base`` is the path of the robot file, for the record.

    Returns:
        results with the keys of flights, and an HTML page.

    Raises:
        LogError: unusable log.

    """
    log = read_joint_log(runs[0])
    others = [read_joint_log(path) for path in [*runs[1:], *holdout]]
    found = Search(log, robot, p).run()
    models = identify_joints(log, robot.joints)
    identified = joint_results(log, others, models, robot.joints, file_servos(robot, log.joints))
    joints = identified['joints']
    result = gap_of(found, log, joints)
    for k, joint in enumerate(joints):
        joint['file_heldout_rms_rad'] = float(found.errors['file'][k])
        joint['corrected_heldout_rms_rad'] = float(found.errors['corrected'][k])
    result['changes'] = [row for other in others for row in changes(log, other, robot, p)]
    result['findings'] = [text for other in others for text in sentences(
        [row for row in result['changes'] if row['log'] == other.name], other.name)]
    identified['text'] = [*identified['text'], *result['findings']]
    sets = any(len(effect['names']) > 1 for effect in result['effects'])
    result |= {'next_experiment': _experiment(joints) if sets else None, 'joints': joints,
               'meta': {'runs': [str(r) for r in runs], 'holdout': [str(h) for h in holdout],
                        'robot': str(base) if base else 'params/robot.yaml',
                        'version': __version__}}
    result['summary'] = summary(result)
    tables = [*grids(result), *change_grids(result['changes'])]
    return result, joint_page(log, others, models, file_servos(robot, log.joints), identified,
                              head(result, _picture(found, log)), tables)


def _picture(found, log):
    """Errors of the file's servos and of the corrected ones over the log."""
    joints, t = np.arange(len(log.joints)), log.t - log.t[0]
    points = [('robot file', BEFORE, found.file_point)]
    if found.accepted:
        points.append(('with named effects', AFTER, found.point))
    with matplotlib.rc_context(STYLE):
        figure, axes = panels(len(joints), 1, height=1.1, sharex=True)
        for text, colour, point in points:
            error = simulate(log, joints, found.servos.sets(point[None])[0])[
                :, :len(t)] - log.measured
            for k, axis in enumerate(axes[:, 0]):
                line(axis, t, 1e3 * error[k], color=colour, lw=0.9, label=text)
                axis.set_ylabel(f'joint {log.joints[k]} [mrad]')
        held_out = t[log.end_of(shipped().servo.fitted)]
        for axis in axes[:, 0]:
            axis.axvspan(t[0], held_out, color='#eef3f8', lw=0)
        axes[-1, 0].set_xlabel('time [s]; shaded: fitted, the rest is held out')
        legend(figure, axes[0, 0])
        return svg(figure, 'error of the simulated servos over the log')


def gap_of(found: Found, log: JointLog, apart: list[dict] | tuple = ()) -> dict:
    """
    Verdict, effects and errors of a search, with the keys of INTERFACES.

    ``apart`` has the results of `identify joint` for each joint alone, for a joint that differs
    from the others.
    """
    effects = _effects(found)
    best = np.minimum(found.errors['free'], found.errors['corrected'])
    if apart:
        best = np.minimum(best, [joint['heldout_rms_rad'] for joint in apart])
    allowed = np.hypot(found.p.log_as_well * best, found.tolerated)
    before, after, floor = (_rms(e) for e in (found.errors['file'],
                                              found.errors['corrected'], best))
    closure = _closure(before, after, floor)
    reason = (f'error on the held-out part {1e3 * before:.1f} mrad before, '
              f'{1e3 * after:.1f} mrad after')
    partial, different = [], int(np.argmax(found.errors['corrected'] / allowed))
    if apart and found.errors['corrected'][different] > allowed[different]:
        # Shared parameters do not explain a joint that differs from the others.
        effects, partial = [], effects
        reason = _joint_differs(apart, different, found.errors['corrected'][different])
        after, closure = before, _closure(before, before, floor)
    return {
        'verdict': _verdict(found, effects, allowed),
        'reason': reason,
        'closure': closure, 'gap_before': before / floor, 'gap_after': after / floor,
        'noise_floor': 1.0, 'effects': effects, 'partial': partial,
        'candidates': _candidates(found), 'hidden': found.undetectable,
        'where': sorted(({'channel': f'joint_{number}', 'regime': 'log',
                          'excess': float(found.errors['file'][k] / best[k]),
                          'excess_after': float(found.errors['corrected'][k] / best[k])}
                         for k, number in enumerate(log.joints)),
                        key=lambda row: -row['excess']),
        'horizons': {'held-out part': {
            'before': before / floor, 'after': after / floor, 'effects_alone': after / floor,
            'placebo': None, 'closure': closure}},
        'regimes': {}, 'held_out': True, 'findings': []}


def _joint_differs(joints, k, error):
    """Reason with the values in which one joint differs from the others."""
    own, others = joints[k], [joint for joint in joints if joint is not joints[k]]
    differences = []
    for term, text, factor, unit in (('natural_frequency', 'natural frequency', 1.0, 'rad/s'),
                                     ('damping_ratio', 'damping ratio', 1.0, ''),
                                     ('delay', 'delay', 1e3, 'ms')):
        usual = np.median([joint['terms'][term]['value'] for joint in others]) if others else 0.0
        differences.append(f'{text} {factor * own["terms"][term]["value"]:.3g}'
                           + (f' against {factor * usual:.3g}' if others else '')
                           + (f' {unit}' if unit else ''))
    return (f'joint {own["joint"]} has an error of {1e3 * error:.1f} mrad with shared parameters '
            f'and of {1e3 * own["heldout_rms_rad"]:.1f} mrad fitted alone: its servo differs '
            f'from the others ({", ".join(differences)})')


def _verdict(found, effects, allowed):
    """
    Verdict of the search.

    Without an effect there is no gap if the file predicts the held-out part as well as the most
    flexible fit, within manufacturing tolerance.
    """
    if effects:
        return 'named_set' if any(len(e['names']) > 1 for e in effects) else 'named'
    return 'no_gap' if (found.errors['file'] <= allowed).all() else 'unknown'


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def _closure(before, after, floor):
    if before <= 1.1 * floor:
        return None
    return float(1 - max(after**2 - floor**2, 0.0) / (before**2 - floor**2))


def _evidence(trial: Trial):
    """Evidence of one entry beside the others; ``cv_gain``: on held-out blocks."""
    held = trial.held
    return {'delta_bic': trial.gain - trial.numbers * float(np.log(trial.samples)),
            'delta_chi2': trial.gain, 'cv_gain': held.total,
            'cv_gain_se': held.sigmas,
            'blocks_positive': int((held.gains > 0).sum())}


def _effects(found: Found):
    """Accepted entries, largest gain first; friction of several joints is one effect."""
    result, friction = [], [t for t in found.accepted if t.entry.name == 'joint_friction'
                            and t.entry in found.sets]
    for trial in found.accepted:
        if trial.entry not in found.sets or trial in friction[1:]:
            continue
        members = found.sets[trial.entry]
        effect = {'names': [t.entry.name for t in members], 'layer': 'joint',
                  'parameters': _parameters(found, members[0].entry),
                  'evidence': _evidence(max(friction, key=lambda t: t.gain)
                                        if trial in friction else members[0])}
        number = trial.entry.joint
        if trial in friction:
            effect['joints'] = _joints(found, friction)
        elif number is not None:
            effect['joint'] = found.servos.joints[number]
        if len(members) > 1:
            effect['rivals'] = [{'name': t.entry.name, 'gain': t.gain, 'evidence': _evidence(t),
                                 'parameters': _parameters(found, t.entry, t.point)}
                                for t in members[1:]]
            effect['separated_by'] = separating_experiment(effect['names'])
        also = _also(found, members)
        if also:
            effect['also'] = also
        result.append(effect)
    return result


def _joints(found, trials):
    if any(t.entry.joint is None for t in trials):
        return list(found.servos.joints)
    return sorted(found.servos.joints[t.entry.joint] for t in trials)


def _also(found, members):
    """Entries that were fitted with an effect and must be written with it, but are not named."""
    also = {t.entry.name: _parameters(found, t.entry) for t in members[1:]
            if any(t.entry == a.entry for a in found.accepted)}
    servos, fitted = found.servos, [t.entry.name for t in found.accepted]
    held = found.point[servos.index('dead_band_held')] > 0.5
    if members[0].entry.name == 'joint_bandwidth' and held and 'joint_friction' not in fitted \
            and servos.friction(found.file_point).any():
        also['joint_friction'] = _parameters(found, Entry('joint_friction'))
    return also


def _parameters(found: Found, entry: Entry, point=None):
    """Parameter -> value, unit, 95 % interval of one entry; ``point``: its own model, if any."""
    servos, other = found.servos, point is not None
    point = found.point if point is None else point
    if entry.name == 'joint_friction':
        return _friction(found, point)
    result, values, file_values = {}, servos.values(point), servos.values(found.file_point)
    for k in np.flatnonzero(servos.mask(entry.name, entry.joint)):
        number, width = servos.numbers[k], 0.0 if other else found.widths[k] * servos.scale[k]
        ends = [values[k] * np.exp(s * width) if number.logarithmic else values[k] + s * width
                for s in (-1, 1)]
        less = servos.delays if number.name == 'delay' else 0.0
        spec = CATALOGUE[entry.name].parameters[number.name]
        value = float(values[k] - less)
        result[number.name] = {'value': value, 'unit': spec.unit,
                               'file': float(file_values[k] - less)}
        if not other:
            low, high = (float(end - less) for end in ends)
            result[number.name]['interval'] = [max(low, min(value, spec.low)),
                                               min(high, max(value, spec.high))]
    return result


def _friction(found, point):
    """Coulomb friction and stiction [N m]: median of the joints, and each joint's value."""
    servos, mask = found.servos, found.servos.mask('joint_friction')
    force, count = servos.friction(point), len(servos.joints)
    torque = servos.friction(np.where(mask, 1.0, point))    # [N m] for each scale of a dead band
    width = found.widths[mask] * torque
    at = servos.index('stiction')
    extra = servos.values(point)[at] / servos.scale[mask] * torque
    unit = CATALOGUE['joint_friction'].parameters['coulomb'].unit
    own = dict(zip(('coulomb', 'stiction'), (float(np.median(
        [value[joint - 1] for joint in servos.joints])) for value in friction(servos.robot)),
                   strict=True))
    result = {}
    for name, value in (('coulomb', force), ('stiction', force + extra)):
        result[name] = {'value': float(np.median(value)), 'unit': unit, 'file': own[name],
                        'interval': [max(float(np.median(value + s * width)), 0.0)
                                     for s in (-1, 1)],
                        'each': {str(servos.joints[j]): float(value[j]) for j in range(count)}}
    return result


def _candidates(found: Found):
    """One row for each entry with its evidence, largest gain first."""
    members = {t.entry: t for group in found.sets.values() for t in group}
    rows = [(t, True) for t in members.values()] + [(t, False) for t in found.rejected]
    result = []
    for trial, accepted in sorted(rows, key=lambda row: (-row[1], -row[0].gain)):
        row = {'name': trial.entry.name, 'accepted': accepted, 'evidence': _evidence(trial),
               'sigma_of_realistic_size': None, 'sigma_beside_rivals': {},
               'reason': '' if accepted else trial.reason}
        if trial.entry.joint is not None:
            row['joint'] = found.servos.joints[trial.entry.joint]
        result.append(row)
    return result


def _experiment(joints):
    plan = joints[0]['experiment']
    return (f'sine of {plan["frequency_Hz"]:g} Hz and {plan["amplitude_rad"]:.2f} rad for '
            f'{plan["duration_s"]:g} s on the joints (separates latency from bandwidth)')
