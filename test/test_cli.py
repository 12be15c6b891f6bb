"""The command line: exit statuses, one-line errors, results of the options."""

import json
import os
from pathlib import Path
import subprocess
import sys

import pytest
from synthetic_flights import fly

import beetle_omni_ros
from beetle_omni_ros import cli
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.control.tasks import make_task

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A short recorded flight."""
    folder = tmp_path_factory.mktemp('cli') / 'flight'
    with BagWriter(folder, {'task': 'waypoints', 'seed': 0, 'conditions': 'nominal'}) as writer:
        fly(writer, make_task('waypoints'), duration=24.5)
    return folder


def refused(capsys, *arguments):
    """Run the command, expect status 2 and one line on standard error; return the line."""
    capsys.readouterr()
    assert cli.main([str(a) for a in arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize('command', [
    [], ['fly'], ['evaluate'], ['compare'], ['faults'], ['report'], ['train'],
    ['identify'], ['check'], ['drive'], ['view']])
def test_every_command_has_help(capsys, command):
    assert cli.main([*command, '--help']) == 0
    assert 'Usage' in (shown := capsys.readouterr().out) and '<bool>' not in shown


@pytest.mark.parametrize('command', [[], ['identify']])
def test_a_command_without_its_subcommand_shows_the_help(capsys, command):
    assert cli.main(command) == 2
    shown = capsys.readouterr()
    assert len((shown.out + shown.err).splitlines()) > 9 and 'error' not in shown.err


@pytest.mark.parametrize(('found', 'text'), [('0123456789+', '0123456789+'), (None, 'unknown')])
def test_the_version_is_printed_with_the_commit_where_it_is_known(capsys, monkeypatch, found,
                                                                 text):
    monkeypatch.setattr('beetle_omni_ros.cli.commit', lambda: found)
    assert cli.main(['--version']) == 0
    assert capsys.readouterr().out == (f'beetle_omni_ros {beetle_omni_ros.__version__}, '
                                        f'commit {text}\n')


def test_help_needs_neither_ros_nor_any_heavy_module():
    program = ('import sys\nfrom beetle_omni_ros import cli\ncli.main(["--help"])\n'
               'heavy = {"rclpy", "mujoco", "matplotlib", "rosbags", "scipy"}\n'
               'sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)')
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True,
                          env={**os.environ, 'PYTHONPATH': str(ROOT)}, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize('command', ['report', 'view', 'gap'])
def test_each_command_reads_the_bags_in_a_folder(capsys, bag, tmp_path, command):
    for name, size in (('first', 300), ('second', 400)):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'cut.mcap').write_bytes((bag / 'flight.mcap').read_bytes()[:size])
    given = [command, tmp_path / 'first' / '..']
    if command == 'report':
        given += ['-o', tmp_path / 'out.gif']
    assert 'first: cut.mcap: cut off after 0 readable messages' in refused(capsys, *given)


def test_report_writes_one_page_that_needs_no_network_also_of_a_truncated_bag(capsys, bag,
                                                                              tmp_path):
    page, result, cut = tmp_path / 'page.html', tmp_path / 'result.json', tmp_path / 'cut'
    cut.mkdir()
    data = (bag / 'flight.mcap').read_bytes()
    (cut / 'cut.mcap').write_bytes(data[:len(data) * 2 // 3])
    assert cli.main(['report', str(bag), str(cut), '-o', str(page), '--json', str(result)]) == 0
    text, printed = page.read_text(), capsys.readouterr()
    # test/pages loads it in a browser, too. Libraries name addresses, and load none.
    assert '<script src' not in text
    for part in ('>flight<', '>cut<', 'cut.mcap: cut off after', 'CPU time of a step',
                 'one MoCap pose was no unit quaternion', 'estimated position'):
        assert part in text
    judged = json.loads(result.read_text())
    assert sum(pose['reached'] for pose in judged['flight']['poses']) == 3
    assert 0 < sum(pose['reached'] for pose in judged['cut']['poses']) < 3
    assert '3 of 15' in printed.out and 'cut off' in printed.err
    assert printed.out.endswith(f'files: {page}\nfiles: {result}\nnext:  open {page} in a '
                                f'browser\nnext:  beetle_omni view {bag} {cut}\n')


def test_check_ends_with_its_file_and_what_was_skipped_as_next(capsys, tmp_path):
    result = tmp_path / 'check.json'
    arguments = ['check', '--skip', 'servos', '--skip', 'board', '--skip', 'ros']
    assert cli.main([*arguments, '--json', str(result)]) == 0
    assert capsys.readouterr().out.endswith(f'files: {result}\nnext:  beetle_omni check\n')


@pytest.mark.parametrize(('command', 'folder', 'module', 'remedy'), [
    ('fly --bag never', 'ros', 'rclpy', 'beetle_omni_ros[ros]'),
    ('train --smoke --output never', 'train', 'torch',
     "run make setup-train in a checkout, or pip install 'beetle_omni_ros[train]'")])
def test_a_missing_library_is_named_with_its_remedy(capsys, monkeypatch, command, folder, module,
                                                    remedy):
    for name in [name for name in sys.modules if name.startswith(f'beetle_omni_ros.{folder}')]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    line = refused(capsys, *command.split())
    assert module in line and remedy in line


@pytest.mark.parametrize(('given', 'meant'), [
    ('a b --holdout c --json g', 'a b --holdout c --json g'),
    ('--robot r a b --holdout c d', '--robot r a b --holdout c --holdout d')])
def test_every_run_after_holdout_is_held_out(given, meant):
    assert cli.spread(given.split()) == meant.split()
