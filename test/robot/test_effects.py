"""Facts about an effect are in its declaration only, not in tables of names elsewhere."""

import ast
from pathlib import Path

import numpy as np
import pytest

from beetle_omni_ros.robot.effects import CATALOGUE, delaying

PACKAGE = Path(__file__).resolve().parents[2] / 'beetle_omni_ros'
PARAMETERS = {name for effect in CATALOGUE.values() for name in effect.parameters}
# The response log's own terms (natural frequency, damping ratio, dead bands) and the numbers of
# simulated faults share a few of the catalogue's words: delay, offset, stiction, velocity_limit.
MOST_TABLES = 6


def is_name(text):
    """Whether a string names an effect, a parameter, or 'effect.parameter[index]'."""
    effect, dot, parameter = text.partition('[')[0].partition('.')
    return effect in CATALOGUE or (dot and parameter in PARAMETERS) or text in PARAMETERS


def tables(package):
    """'file: name' of each module-level literal with two or more such names."""
    found = []
    for path in sorted(package.rglob('*.py')):
        if path.is_relative_to(package / 'robot'):
            continue
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
                continue
            names = {item.value for item in ast.walk(node.value) if isinstance(item, ast.Constant)
                     and isinstance(item.value, str) and is_name(item.value)}
            if len(names) >= 2:
                target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
                found.append(f'{path.relative_to(package)}: {ast.unparse(target)}')
    return found


def test_few_tables_outside_robot_have_effect_names_as_keys():
    found = tables(PACKAGE)
    assert len(found) <= MOST_TABLES, '\n'.join(found)


def test_the_check_counts_a_table_of_effects(tmp_path):
    (tmp_path / 'a.py').write_text("LATE = {'mocap_time_offset.delay': 1, 'imu_filter_lag': 2}\n"
                                   "ONE = ('mass',)\nWORDS = ('force_x', 'torque')\n")
    assert tables(tmp_path) == ['a.py: LATE']


@pytest.mark.parametrize('name', CATALOGUE)
def test_a_declaration_is_complete_and_consistent(name):
    effect = CATALOGUE[name]
    assert effect.source and effect.excited_by and effect.separated_by
    assert all(other in CATALOGUE for other in effect.confused_with)
    assert set(effect.channels) <= set('BAWJ') and effect.channels
    rival = effect.same_response
    assert not rival or CATALOGUE[rival].same_response == name
    for form in effect.forms:
        assert set(form) <= set(effect.parameters) - set(effect.numbers)
    if isinstance(effect.starts, tuple):
        assert all(len(start) == len(effect.numbers) for start in effect.starts)
    for spec in effect.parameters.values():
        neutral = np.array(spec.neutral, dtype=float)
        assert np.isnan(neutral).all() == bool(spec.number)
        assert np.all(np.isnan(neutral) | (neutral >= spec.low) & (neutral <= spec.high))
        assert spec.step > 0 and (spec.form or spec.typical > spec.smallest > 0)


def test_delays_of_commands_and_readings_are_declared():
    assert delaying('tilt') == ('command_latency', 'joint_command_latency')
    assert delaying('thrust') == ('rotor_dead_time', 'command_latency')
    assert delaying('imu', 'encoders') == ('joint_feedback_delay', 'imu_filter_lag')
