"""A folder of the user's own for locks and ports, where nobody else can put anything."""

import atexit
from contextlib import contextmanager
import os
from pathlib import Path
import shutil
import stat
import tempfile

NAME = 'beetle_omni'


def folder() -> Path:
    """
    Make or find the user's folder: in the runtime folder of the system, else the temporary one.

    The runtime folder is looked for even where nobody tells of it (cron, ssh), so that two
    processes of a user do not look for each other's locks in two places.

    Raises:
        OSError: neither can be made, or what stands there is a link, somebody else's, or open
            to others; one line.

    """
    runtime = Path(os.environ.get('XDG_RUNTIME_DIR') or f'/run/user/{os.getuid()}')
    try:
        _check(runtime)
        return _own(runtime / NAME)
    except OSError:
        return _own(Path(tempfile.gettempdir()) / f'{NAME}_{os.getuid()}')


@contextmanager
def lock_file(name: str):
    """
    Open a file of :func:`folder` for locking, as it is: nothing is truncated, no link followed.

    Args:
        name: of the file, without folders.

    Yields:
        The file, readable and writable, at its beginning.

    Raises:
        OSError: no folder, or the file is a link, special, or somebody else's; one line.

    """
    file = open_lock(name)
    try:
        yield file
    finally:
        file.close()


def open_lock(name: str):
    """Like :func:`lock_file`; the caller closes."""
    place = folder()
    parent = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        _judge(os.fstat(parent), place)     # the folder that is used, not one of the same name
        number = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600,
                         dir_fd=parent)
    except OSError as error:
        raise OSError(f'{place / name}: cannot be used as a lock '
                      f'({error.strerror or error})') from None
    finally:
        os.close(parent)
    found = os.fstat(number)
    if not stat.S_ISREG(found.st_mode) or found.st_uid != os.getuid() or found.st_nlink != 1:
        os.close(number)
        raise OSError(f'{place / name}: expected a file of this user with one name; remove it')
    return os.fdopen(number, 'r+')


def scratch(name: str) -> Path:
    """
    Make a folder that goes with this process; those of processes that were killed go now.

    Raises:
        OSError: it cannot be made.

    """
    place = folder()
    for left in place.glob(f'{name}_*_*'):
        process = left.name.split('_')[-2]
        if process.isdigit() and not Path(f'/proc/{process}').exists():
            shutil.rmtree(left, ignore_errors=True)
    made = Path(tempfile.mkdtemp(prefix=f'{name}_{os.getpid()}_', suffix='', dir=place))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def _own(path):
    """Make the folder where it is missing; the checked path."""
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        pass
    _check(path)
    return path


def _check(path):
    _judge(os.lstat(path), path)


def _judge(found, path):
    """Refuse what is no folder, or a folder that others may own or enter."""
    if not stat.S_ISDIR(found.st_mode):
        raise OSError(f'{path}: expected a folder, found a link or file; remove it')
    if found.st_uid != os.getuid():
        raise OSError(f'{path}: belongs to user {found.st_uid}, expected {os.getuid()}; remove it '
                      'or set XDG_RUNTIME_DIR')
    if found.st_mode & 0o077:
        raise OSError(f'{path}: open to other users (mode {stat.S_IMODE(found.st_mode):o}), '
                      f'expected 700; chmod 700 {path}')
