"""Answers are scored by verdict, exit status, names and words."""

from pathlib import Path

import gap_damage
from gap_damage_kinds import report
from gap_damage_kinds.catalogue import KINDS
from gap_damage_kinds.judge import judge, statements
import pytest

UNANSWERED = {'status': 124, 'answer': None, 'seconds': 300.0, 'crash': False, 'message': '',
              'folder': '/x', 'onset': None, 'begin': 0.0}


def asked(verdict, status=0, *, names=(), reason='', findings=(), bad=()):
    return {**UNANSWERED, 'status': status, 'answer': {
        'verdict': verdict, 'effects': [{'names': [n]} for n in names], 'reason': reason,
        'findings': list(findings), 'bad_data': list(bad)}}


def refused(topic, cause, at_s=None, status=3):
    return asked('bad_data', status, bad=[{'run': 'a', 'topic': topic, 'cause': cause,
                                           'at_s': at_s, 'sure': True}])


MILLIMETRES = KINDS['mocap_millimetres']


def test_cause_in_words_and_topic_are_accepted():
    found = judge(MILLIMETRES, refused('mocap/pose', 'position in millimetres'))
    assert found.right and found.cause and found.topic and found.onset is None


@pytest.mark.parametrize('answer', [
    refused('mocap/pose', 'position in millimetres', status=0),
    refused('mocap/pose', 'the pose jumps'), asked('no_gap'), asked('unknown'),
    asked('named', names=['mass'], findings=['mocap/pose in millimetres']),
    UNANSWERED])
def test_other_answers_are_not_accepted(answer):
    assert not judge(MILLIMETRES, answer).right


def test_a_topic_in_the_text_counts_and_folder_names_do_not():
    text = statements(asked('bad_data', reason='/x/millimetres/a: /imu/data_raw is bad')['answer'],
                      '/x/millimetres')
    assert 'milli' not in text[0]['text'] and 'imu/data_raw' in text[0]['text']
    found = judge(MILLIMETRES, refused('imu/data_raw', 'in millimetres'))
    assert found.cause and not found.topic


@pytest.mark.parametrize(('at_s', 'near'), [(28.0, True), (18.5, True), (35.0, False)])
def test_a_time_counts_as_stamp_or_from_the_start(at_s, near):
    kind = KINDS['mocap_clock_back']
    found = judge(kind, refused('mocap/pose', 'the clock jumps back', at_s)
                  | {'onset': 28.5, 'begin': 10.0})
    assert found.onset is near


def test_repairable_damage_may_be_used_if_it_is_reported():
    kind = KINDS['imu_spike']
    judged = judge(kind, asked('no_gap', findings=['imu/data_raw: a spike at 3.0 s'])
                   | {'onset': 3.0})
    assert judged.right and judged.onset
    assert not judge(kind, asked('no_gap')).right


def test_controls_must_be_used():
    kind = KINDS['nothing']
    assert judge(kind, asked('no_gap')).right
    assert judge(kind, asked('named', names=['mass']), ('mass',)).right
    assert not judge(kind, asked('named', names=['mass'])).right
    assert not judge(kind, refused('mocap/pose', 'odd')).right


def test_totals_and_files(tmp_path):
    results = {'mocap_millimetres': [judge(MILLIMETRES, answer) for answer in (
        refused('mocap/pose', 'in millimetres'), asked('no_gap'))]}
    found = report.totals(results, KINDS)
    assert (found['damaged'], found['no_gap'], found['cause'], found['right']) == (2, 1, 1, 1)
    report.write(results, KINDS, {'command': 'x'}, tmp_path)
    assert 'mocap_millimetres' in (tmp_path / 'damage.md').read_text()


def test_folder_names_of_damaged_bags_reveal_no_cause():
    place = gap_damage.place_of(Path('x'), 'mocap_millimetres', 0)
    assert not MILLIMETRES.is_stated_in(str(place))


def test_unknown_kinds_are_refused(capsys):
    with pytest.raises(SystemExit):
        gap_damage.parse(['--kinds', 'mocap_in_feet'])
    assert 'mocap_in_feet' in capsys.readouterr().err
