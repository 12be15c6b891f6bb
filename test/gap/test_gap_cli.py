"""The command line of gap: fitted and held-out runs."""

import pytest

from beetle_omni_ros import cli
from beetle_omni_ros.cli.commands import spread
from beetle_omni_ros.identify.gap import command


@pytest.mark.parametrize(('given', 'meant'), [
    ('a b --holdout c --json g', 'a b --holdout c --json g'),
    ('a b --holdout c d --apply f', 'a b --holdout c --holdout d --apply f'),
    ('--robot r a b --holdout c d', '--robot r a b --holdout c --holdout d'),
    ('--holdout c a b', '--holdout c a b'),
    ('a --holdout c --holdout d', 'a --holdout c --holdout d')])
def test_every_run_after_holdout_is_held_out(given, meant):
    assert spread(given.split()) == meant.split()


def test_files_are_written_before_anything_is_printed(tmp_path, monkeypatch):
    def broken(*_):
        raise SystemExit(1)

    monkeypatch.setattr(command, 'analyse_joint_logs',
                        lambda *_: ({'effects': [], 'changes': []}, None))
    monkeypatch.setattr(command, 'gap_log_page', lambda *_: '<html>')
    monkeypatch.setattr(command, 'grids', lambda _: [])
    monkeypatch.setattr(command, '_print', broken)
    (tmp_path / 'log.csv').touch()
    files = [tmp_path / 'gap.json', tmp_path / 'gap.html']
    with pytest.raises(SystemExit):
        command.run_gap([tmp_path / 'log.csv'], json_path=files[0], page=files[1])
    assert all(file.stat().st_size for file in files)


def test_unusable_input_is_one_line(tmp_path, capsys):
    assert cli.main(['gap', str(tmp_path / 'none'), '--robot', str(tmp_path / 'no.yaml')]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
