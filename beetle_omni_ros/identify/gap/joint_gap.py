"""The joint layer alone: a servo's response log, judged as flights are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.joint import identify_joints
from beetle_omni_ros.identify.joint_log import read_joint_log
from beetle_omni_ros.identify.joint_page import joint_page
from beetle_omni_ros.identify.joint_results import joint_results
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters

# Terms of the servo model -> catalogue entry, its parameter, and how to get there from radians.
ENTRIES = {'coulomb_friction': ('joint_friction', 'coulomb', 'stiffness'),
           'backlash': ('joint_backlash', 'gap', 'both sides'),
           'delay': ('joint_command_latency', 'delay', ''),
           'velocity_limit': ('joint_velocity_limit', 'velocity_limit', ''),
           'torque_limit': ('joint_torque_limit', 'effort_limit', 'stiffness')}
CHANGED = 0.15          # of frequency or damping: another bandwidth than published
LEAST_GAIN = 5.0        # of error before over after, below which nothing is named


def analyse_joint_log(runs: list[Path], holdout: list[Path], robot: RobotParameters,
                      base: Path | None) -> tuple[dict, str]:
    """
    Judge a response log.

    Args:
        runs: the log; further ones only judge, as do those of ``holdout``.
        holdout: further logs.
        robot: as believed.
        base: its file, for the record.

    Returns:
        results as for flights, and an HTML page.

    Raises:
        LogError: unusable log.

    """
    log = read_joint_log(runs[0])
    others = [read_joint_log(path) for path in [*runs[1:], *holdout]]
    models = identify_joints(log, robot.joints)
    found = joint_results(log, others, models, robot.joints)
    joints = found['joints']
    before = _rms(j['published_heldout_rms_rad'] for j in joints)
    after = _rms(j['heldout_rms_rad'] for j in joints)
    floor = min(log.quantum / np.sqrt(12), after)
    effects = [*_effects(joints, models), *_timing(joints, models, robot)]
    if before < 1.5 * floor or before / after < LEAST_GAIN ** (len(effects) == 0):
        effects = effects if before > 1.5 * after else []
    sets = any(len(effect['names']) > 1 for effect in effects)
    verdict = ('no_gap' if before < 2 * floor else 'unknown') if not effects else \
        'named_set' if sets else 'named'
    scale = max(floor, 1e-9)
    made = {
        'verdict': verdict,
        'reason': f'error on the held-out part {1e3 * before:.1f} mrad before, '
                  f'{1e3 * after:.1f} mrad after',
        'closure': _closure(before, after, floor), 'gap_before': before / scale,
        'gap_after': after / scale, 'noise_floor': floor / scale, 'effects': effects,
        'partial': [], 'candidates': _candidates(models, joints),
        'where': sorted(({'channel': f'joint_{j["joint"]}', 'regime': 'log',
                          'excess': j['published_heldout_rms_rad'] / scale,
                          'excess_after': j['heldout_rms_rad'] / scale} for j in joints),
                        key=lambda row: -row['excess']),
        'next_experiment': _experiment(joints) if sets else None,
        'horizons': {'held-out part': {
            'before': before / scale, 'after': after / scale, 'effects_alone': after / scale,
            'placebo': None, 'closure': _closure(before, after, floor)}},
        'regimes': {}, 'held_out': True, 'findings': [], 'joints': joints,
        'meta': {'runs': [str(r) for r in runs], 'holdout': [str(h) for h in holdout],
                 'robot': str(base) if base else 'params/robot.yaml', 'version': __version__}}
    return made, joint_page(log, others, models, robot.joints, found)


def _rms(values):
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _closure(before, after, floor):
    if before <= 1.1 * floor:
        return None
    return float(1 - max(after**2 - floor**2, 0.0) / (before**2 - floor**2))


def _kept(joints, term):
    return [j for j in joints if j['terms'][term]['kept']]


def _value(joint, term, how):
    stiffness = {'stiffness': joint['derived']['kp_N_m_per_rad'], 'both sides': 2.0}.get(how, 1.0)
    entry = joint['terms'][term]
    return [stiffness * x if x is not None else None
            for x in (entry['value'], *entry['interval'])]


def _entry(joints, term, name, parameter, how):
    """Median over the joints, and the widest interval that a median can have."""
    values = [_value(j, term, how) for j in joints]
    middle = float(np.median([v[0] for v in values]))
    low, high = (float(np.median([v[k] if v[k] is not None else v[0] for v in values]))
                 for k in (1, 2))
    return {'value': middle, 'unit': CATALOGUE[name].parameters[parameter].unit,
            'interval': [low, high],
            'each': {str(j['joint']): v[0] for j, v in zip(joints, values, strict=True)}}


def _evidence(models, term, joints):
    gains = [m.gain.get(term, 0.0) for m in models if any(j['joint'] == m.joint for j in joints)]
    return {'delta_bic': float(np.sum(gains)), 'delta_chi2': float(np.sum(gains)),
            'cv_gain': float(np.sum(gains)), 'cv_gain_se': float(len(gains)),
            'joints': len(gains)}


def _effects(joints, models):
    made = []
    for term, (name, parameter, how) in ENTRIES.items():
        having = _kept(joints, term)
        if term == 'delay' or 2 * len(having) < len(joints) or not having:
            continue
        entries = {parameter: _entry(having, term, name, parameter, how)}
        if name == 'joint_friction':
            entries['stiction'] = _with_stiction(having, entries['coulomb'])
        made.append({'names': [name], 'layer': 'joint', 'parameters': entries,
                     'joints': [j['joint'] for j in having],
                     'evidence': _evidence(models, term, having)})
    return made


def _with_stiction(joints, coulomb):
    """Breakaway torque: sliding friction and what sticking adds, where it was found."""
    extra = [_value(j, 'stiction', 'stiffness')[0] if j['terms']['stiction']['kept'] else 0.0
             for j in joints]
    more = float(np.median(extra))
    return {**coulomb, 'value': coulomb['value'] + more,
            'interval': [v + more for v in coulomb['interval']]}


def _timing(joints, models, robot):
    """Delay, bandwidth, or the set of the two where the log trades them."""
    delayed = _kept(joints, 'delay')
    frequency = np.median([j['terms']['natural_frequency']['value'] for j in joints])
    damping = np.median([j['terms']['damping_ratio']['value'] for j in joints])
    changed = abs(frequency / robot.joints.natural_frequency - 1) > CHANGED or abs(
        damping / robot.joints.damping_ratio - 1) > CHANGED
    traded = any({'delay', 'natural_frequency'} <= set(pair) for j in joints
                 for pair in j['traded'])
    names = [name for name, there in (('joint_command_latency', bool(delayed)),
                                      ('joint_bandwidth', changed)) if there]
    if not names:
        return []
    bandwidth = {'kp': _derived(joints, 'kp_N_m_per_rad', 'N m/rad'),
                 'kd': _derived(joints, 'kd_N_m_s_per_rad', 'N m s/rad')}
    delay = {'delay': _entry(delayed, 'delay', 'joint_command_latency', 'delay', '')} \
        if delayed else {}
    parts = {'joint_command_latency': delay, 'joint_bandwidth': bandwidth}
    evidence = _evidence(models, 'delay', delayed or joints)
    if traded and delayed:
        return [{'names': list(dict.fromkeys([*names, 'joint_bandwidth'])), 'layer': 'joint',
                 'parameters': delay, 'also': {'joint_bandwidth': bandwidth},
                 'evidence': evidence,
                 'separated_by': CATALOGUE['joint_command_latency'].separated_by}]
    return [{'names': [name], 'layer': 'joint', 'parameters': parts[name], 'evidence': evidence}
            for name in names]


def _derived(joints, key, unit):
    values = [j['derived'][key] for j in joints]
    middle, spread = float(np.median(values)), float(np.ptp(values)) / 2
    return {'value': middle, 'unit': unit, 'interval': [middle - spread, middle + spread]}


def _candidates(models, joints):
    rows = []
    for term, (name, _, _) in ENTRIES.items():
        having = _kept(joints, term)
        evidence = _evidence(models, term, joints)
        rows.append({'name': name, 'accepted': 2 * len(having) >= len(joints) and bool(having),
                     'evidence': evidence, 'sigma_of_realistic_size': None,
                     'sigma_beside_rivals': {},
                     'reason': '' if having else 'does not help on data left out'})
    return sorted(rows, key=lambda row: -row['evidence']['delta_chi2'])


def _experiment(joints):
    plan = joints[0]['experiment']
    return (f'sine of {plan["frequency_Hz"]:g} Hz and {plan["amplitude_rad"]:.2f} rad for '
            f'{plan["duration_s"]:g} s on the joints (separates latency from bandwidth)')
