"""Work on several cores gives what one core gives, whatever happens to a child."""

import os
from pathlib import Path
import sys
import time

import numpy as np
import pytest

from beetle_omni_ros.identify.gap import forks
from beetle_omni_ros.identify.gap.forks import forked, team, width

pytestmark = pytest.mark.skipif(sys.platform != 'linux', reason='forks on Linux only')


def children():
    return {process for tasks in Path('/proc/self/task').glob('*/children')
            for process in tasks.read_text().split()}


@pytest.fixture(params=[1, 2, 3])
def cores(request, monkeypatch):
    monkeypatch.setattr(forks, 'width', lambda: request.param)
    return request.param


def test_results_come_in_the_order_of_the_items(cores):
    rng = np.random.default_rng(0)
    big = rng.normal(size=(200, 5000))      # more than a pipe holds
    made = forked(lambda k: (k, big[:, :k] + k), range(7))
    assert [k for k, _ in made] == list(range(7))
    assert all(np.array_equal(array, big[:, :k] + k) for k, array in made)
    assert forked(lambda k: k, []) == []


def test_children_do_the_work_and_end(cores):
    parent = os.getpid()
    by = forked(lambda _: os.getpid(), range(6))
    assert by[0] == parent and len(set(by)) == cores
    for process in set(by) - {parent}:
        with pytest.raises(ChildProcessError):
            os.waitpid(process, 0)


def test_a_piece_of_work_is_not_split_again(cores, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: set(range(cores)))
    monkeypatch.delenv('OMP_NUM_THREADS', raising=False)
    inner = forked(lambda _: width(), range(cores))
    assert inner == [1] * cores


@pytest.mark.parametrize('bad', [0, 1, 2])
def test_an_error_of_any_item_is_raised_and_nobody_is_left(cores, bad):
    def work(k):
        if k == bad:
            raise ValueError(f'item {k}')
        time.sleep(0.01)
        return k

    before = children()
    with pytest.raises(ValueError, match=f'item {bad}'):
        forked(work, range(6))
    assert children() == before


def test_what_a_dead_child_leaves_is_done_here(cores):
    parent = os.getpid()

    def work(k):
        if os.getpid() != parent:
            os.kill(os.getpid(), 9)
        return k * k

    assert forked(work, range(5)) == [0, 1, 4, 9, 16]


def test_what_cannot_be_sent_is_made_again_here(cores):
    made = forked(lambda k: (lambda: k), range(4))
    assert [function() for function in made] == [0, 1, 2, 3]


@pytest.mark.parametrize('threads, expected', [('1', 1), ('2', 2), ('99', 3), ('', 3), ('x', 3)])
def test_who_limits_threads_limits_processes(monkeypatch, threads, expected):
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: {0, 1, 2})
    monkeypatch.setenv('OMP_NUM_THREADS', threads)
    assert width() == expected


def test_a_team_shares_what_each_of_its_members_asks_for(cores):
    rng = np.random.default_rng(0)
    big = rng.normal(size=(200, 5000))
    before = children()
    with team() as first:
        total = 0.0
        for step in range(4):
            made = forked(lambda k, add=total: big[:, k] + add, range(7))
            total += float(np.sum(made))        # the next pieces depend on all of these
        by = forked(lambda _: os.getpid(), range(6))
    expected = 0.0
    for step in range(4):
        expected += float(np.sum([big[:, k] + expected for k in range(7)]))
    assert first and total == expected
    assert by[0] == os.getpid() and len(set(by)) == cores and children() == before


def test_what_a_member_has_learnt_stays_with_it(cores):
    learnt = []
    with team():
        for _ in range(3):
            counts = forked(lambda k: (learnt.append(k), len(learnt))[1], range(cores))
    assert counts == [3] * cores


def test_only_the_first_goes_on_after_the_block_and_shows_anything(cores, capfd, tmp_path):
    with team() as first:
        if first:
            print('first')
        os.write(1, b'everybody ')
    with (tmp_path / 'after').open('a') as file:
        file.write('x')
    time.sleep(0.05)
    assert (tmp_path / 'after').read_text() == 'x'
    assert sorted(capfd.readouterr().out.split()) == ['everybody', 'first']


@pytest.mark.parametrize('bad', [0, 1, 2])
def test_an_error_in_a_team_is_raised_and_nobody_is_left(cores, bad):
    def work(k):
        if k == bad:
            raise ValueError(f'item {k}')
        return k

    before = children()
    with pytest.raises(ValueError, match=f'item {bad}'), team():
        forked(work, range(6))
    assert children() == before
    with team():
        assert forked(lambda k: k, range(6)) == list(range(6))      # and another may begin


def test_an_error_of_the_first_alone_ends_the_others(cores):
    before = children()
    with pytest.raises(KeyError), team() as first:
        forked(lambda k: k, range(6))
        if first:
            raise KeyError
        forked(lambda k: k, range(6))
    assert children() == before


def dies(k):
    os.kill(os.getpid(), 9)


def leaves(k):
    os._exit(0)


@pytest.mark.parametrize('end', [dies, leaves])
def test_who_is_left_of_a_team_does_the_rest(cores, end):
    parent = os.getpid()
    before = children()
    with team():
        made = forked(lambda k: k * k if os.getpid() == parent else end(k), range(5))
        again = forked(lambda k: (k, os.getpid()), range(5))
    assert made == [0, 1, 4, 9, 16] and children() == before
    assert again == [(k, parent) for k in range(5)] or cores == 1


def test_a_member_that_comes_to_another_decision_is_left_behind(cores):
    parent = os.getpid()
    with team():
        count = 6 if os.getpid() == parent else 5
        assert forked(lambda k: k, range(count)) == list(range(count))
        assert forked(lambda _: os.getpid(), range(6)) == [parent] * 6


def test_what_a_team_cannot_send_is_made_here(cores):
    with team():
        made = forked(lambda k: (lambda: k), range(4))
        assert [function() for function in made] == [0, 1, 2, 3]
        assert forked(lambda k: k, range(3)) == [0, 1, 2]
