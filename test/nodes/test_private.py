"""Locks and ports are in a private folder, and are removed."""

import os
from pathlib import Path
import stat
import subprocess
import sys

import pytest

from beetle_omni_ros.nodes import discovery, private


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Temporary folder of a computer without a runtime folder."""
    monkeypatch.setattr(private.tempfile, 'gettempdir', lambda: str(tmp_path))
    monkeypatch.setenv('XDG_RUNTIME_DIR', str(tmp_path / 'none'))
    return tmp_path


@pytest.fixture
def name():
    return f'beetle_omni_{os.getuid()}'


def test_the_folder_is_private_and_the_runtime_folder_is_preferred_if_it_is_safe(
        temporary, name, monkeypatch):
    assert private.folder() == temporary / name
    assert stat.S_IMODE(os.lstat(temporary / name).st_mode) == 0o700
    runtime = temporary / 'runtime'
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv('XDG_RUNTIME_DIR', str(runtime))
    assert private.folder() == runtime / 'beetle_omni'
    runtime.chmod(0o755)
    assert private.folder().parent == temporary


@pytest.mark.parametrize(('make', 'expected'), [
    (lambda path: path.symlink_to(path.parent), 'found a link or file'),
    (lambda path: path.mkdir() or path.chmod(0o777), 'open to other users .mode 777.'),
    (lambda path: path.mkdir(0o700) or os.chown(path, 12345, -1), 'belongs to user 12345')])
def test_a_folder_that_is_not_this_users_alone_is_refused(temporary, name, make, expected):
    try:
        make(temporary / name)
    except PermissionError:
        pytest.skip('only root can give files away')
    with pytest.raises(OSError, match=expected), discovery.reserved_domain():
        pass


@pytest.mark.parametrize('link', [os.symlink, os.link])
def test_a_linked_file_of_the_user_is_not_truncated(temporary, link):
    victim = temporary / 'victim'
    victim.write_text('precious')
    link(victim, private.folder() / 'x.lock')
    with pytest.raises(OSError, match='lock'):
        private.Lock('x.lock')
    assert victim.read_text() == 'precious'


def test_a_lock_names_its_holder_and_removes_its_file(temporary):
    lock = private.Lock('x.lock')
    for _ in range(2):
        with pytest.raises(private.HeldError, match=str(os.getpid())):
            private.Lock('x.lock')
    lock.close()
    assert not list(temporary.iterdir())


def test_a_domain_leaves_only_the_locks_of_running_processes(temporary):
    with discovery.reserved_domain() as number:
        alive = private.Lock(f'{number}.ekf_node.lock')
        (private.folder() / f'{number}.sim_node.lock').write_text('999999999')   # was killed
    assert [path.name for path in private.folder().iterdir()] == [f'{number}.ekf_node.lock']
    alive.close()
    assert not list(temporary.iterdir())


def test_folders_are_removed_with_their_process_or_at_the_next_start(temporary):
    place = private.folder()
    (place / 'ports_999999999_abc').mkdir()
    (place / f'ports_{os.getpid()}_abc').mkdir()
    script = ('import sys; from beetle_omni_ros.nodes import private\n'
              f'private.folder = lambda: private.Path({str(place)!r})\n'
              'print(private.process_folder("ports"))')
    done = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          check=True, timeout=60)
    made = Path(done.stdout.strip())
    assert made.parent == place and not made.exists()
    assert [path.name for path in place.iterdir()] == [f'ports_{os.getpid()}_abc']
