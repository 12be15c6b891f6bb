"""A folder of the user's own for locks and ports, where nobody else can put anything."""

import atexit
import fcntl
import os
from pathlib import Path
import shutil
import stat
import tempfile

NAME = 'beetle_omni'
ATTEMPTS = 10       # to open what others may be removing
HOLDER = 20         # characters of a process's number


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


class HeldError(Exception):
    """A lock is held by another process; the text is its number, or ''."""


class Lock:
    """
    A lock of this process under a name, until :meth:`close` or the process's end.

    Its file goes with it; that of a process that was killed stays until the name is used again.

    Raises:
        HeldError: another process holds it.
        OSError: no folder, or the file is a link, special, or somebody else's; one line.

    """

    def __init__(self, name: str):
        """Take the lock at once, or not at all."""
        for _ in range(ATTEMPTS):
            self._file, self._path = open_lock(name), folder() / name
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                holder = self._file.read(HOLDER).strip()
                self._file.close()
                raise HeldError(holder) from None
            if self._is_in_place():
                break
            self._file.close()      # its last holder has just removed it
        else:
            raise OSError(f'{folder() / name}: comes and goes, cannot be used as a lock')
        self._file.truncate(0)
        self._file.write(str(os.getpid()))
        self._file.flush()

    def close(self) -> None:
        """Let go of the lock, and of the folder where it was the last thing in it."""
        if not self._file.closed:
            if self._is_in_place():
                self._path.unlink(missing_ok=True)
            self._file.close()
            _leave(self._path.parent)

    def _is_in_place(self):
        """Whether the file that is locked is the one that others would find."""
        try:
            return os.path.samestat(os.lstat(self._path), os.fstat(self._file.fileno()))
        except OSError:
            return False


def forget(pattern: str) -> None:
    """Remove the files of locks that nobody holds any more; for names that nobody takes now."""
    for path in folder().glob(pattern):
        try:
            Lock(path.name).close()
        except (HeldError, OSError):
            pass


def open_lock(name: str):
    """
    Open a file of :func:`folder` for locking, as it is: nothing is truncated, no link followed.

    Args:
        name: of the file, without folders.

    Returns:
        The file, readable and writable, at its beginning.

    Raises:
        OSError: no folder, or the file is a link, special, or somebody else's; one line.

    """
    for left in reversed(range(ATTEMPTS)):
        try:
            return _open(name)
        except FileNotFoundError:       # who used the folder last has just removed it
            if not left:
                raise


def _open(name):
    place = folder()
    parent = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        _judge(os.fstat(parent), place)     # the folder that is used, not one of the same name
        number = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600,
                         dir_fd=parent)
    except FileNotFoundError:
        raise
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
    atexit.register(_remove, made)
    return made


def _remove(made):
    shutil.rmtree(made, ignore_errors=True)
    _leave(made.parent)


def _leave(place):
    """Remove the folder where nothing is left in it."""
    try:
        place.rmdir()
    except OSError:
        pass


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
