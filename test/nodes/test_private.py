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


def test_the_folder_is_private_to_this_user(temporary, name):
    assert private.folder() == temporary / name
    assert stat.S_IMODE(os.lstat(temporary / name).st_mode) == 0o700


def test_the_runtime_folder_is_preferred_if_it_is_safe(temporary, monkeypatch):
    runtime = temporary / 'runtime'
    runtime.mkdir(mode=0o700)
    monkeypatch.setenv('XDG_RUNTIME_DIR', str(runtime))
    assert private.folder() == runtime / 'beetle_omni'
    runtime.chmod(0o755)
    assert private.folder().parent == temporary


def test_a_link_in_place_of_the_folder_is_refused(temporary, name):
    (temporary / 'victim').mkdir(mode=0o700)
    (temporary / name).symlink_to(temporary / 'victim')
    with pytest.raises(OSError, match='found a link or file'), discovery.reserved_domain():
        pass
    assert not list((temporary / 'victim').iterdir())


def test_a_folder_that_others_may_enter_is_refused(temporary, name):
    (temporary / name).mkdir()
    (temporary / name).chmod(0o777)
    with pytest.raises(OSError, match='open to other users .mode 777.'), \
            discovery.reserved_domain():
        pass


@pytest.mark.skipif(os.getuid() != 0, reason='only root can give files away')
def test_a_folder_of_another_user_is_refused(temporary, name):
    (temporary / name).mkdir(mode=0o700)
    os.chown(temporary / name, 12345, -1)
    with pytest.raises(OSError, match='belongs to user 12345'), discovery.reserved_domain():
        pass


@pytest.mark.parametrize('link', [os.symlink, os.link])
def test_a_linked_file_of_the_user_is_not_truncated(temporary, link):
    victim = temporary / 'victim'
    victim.write_text('precious')
    for number in discovery.DOMAINS:
        link(victim, private.folder() / f'domain{number}.lock')
    with pytest.raises(OSError, match='lock'), discovery.reserved_domain():
        pass
    assert victim.read_text() == 'precious'


def test_a_pipe_in_place_of_a_lock_is_refused_at_once(temporary):
    os.mkfifo(private.folder() / 'x.lock')
    with pytest.raises(OSError, match='expected a file of this user'):
        private.open_lock('x.lock')


def test_a_lock_file_is_not_truncated_before_it_is_held(temporary):
    (private.folder() / 'x.lock').write_text('4711')
    with private.open_lock('x.lock') as file:
        assert file.read() == '4711'


def test_a_lock_names_its_holder_and_removes_its_file(temporary, name):
    lock = private.Lock('x.lock')
    with pytest.raises(private.HeldError, match=str(os.getpid())):
        private.Lock('x.lock')
    lock.close()
    lock.close()
    assert not list(temporary.iterdir())
    private.Lock('x.lock').close()


def test_a_lock_file_removed_during_locking_is_created_again(temporary, monkeypatch):
    first, opened = private.Lock('x.lock'), private.open_lock

    def late(name):
        file = opened(name)
        first.close()       # between the opening and the lock
        return file

    monkeypatch.setattr(private, 'open_lock', late)
    second = private.Lock('x.lock')
    monkeypatch.setattr(private, 'open_lock', opened)
    assert (private.folder() / 'x.lock').read_text() == str(os.getpid())
    with pytest.raises(private.HeldError):
        private.Lock('x.lock')
    second.close()


def test_a_domain_leaves_only_the_locks_of_running_processes(temporary):
    with discovery.reserved_domain() as number:
        alive = private.Lock(f'{number}.ekf_node.lock')
        (private.folder() / f'{number}.sim_node.lock').write_text('999999999')   # was killed
    assert [path.name for path in private.folder().iterdir()] == [f'{number}.ekf_node.lock']
    alive.close()
    assert not list(temporary.iterdir())


def test_a_node_does_not_write_through_a_link(temporary):
    from beetle_omni_ros.nodes.node import lock_name
    victim = temporary / 'victim'
    victim.write_text('precious')
    warnings = []

    class Node:
        context = property(lambda self: self)

        def get_domain_id(self):
            return 7

        def get_fully_qualified_name(self):
            return '/ekf_node'

        def get_logger(self):
            return self

        def warning(self, text):
            warnings.append(text)

    (private.folder() / '7.ekf_node.lock').symlink_to(victim)
    assert lock_name(Node()) is None
    assert victim.read_text() == 'precious' and '7.ekf_node.lock' in warnings[0]


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
