"""A private folder of the user for locks and ports, not writable for other users."""

import atexit
import fcntl
import os
from pathlib import Path
import shutil
import stat
import tempfile

NAME = 'beetle_omni'
ATTEMPTS = 10       # to open a file that another process may be removing
HOLDER = 20         # most characters of a process id


def folder() -> Path:
    """
    Make or find the user's folder: in the runtime folder of the system, else the temporary one.

    The runtime folder is also used if ``XDG_RUNTIME_DIR`` is not set (cron, ssh), so that all
    processes of a user share one folder.

    Raises:
        OSError: the folder cannot be made, is a link, has another owner, or is open to others.

    """
    runtime = Path(os.environ.get('XDG_RUNTIME_DIR') or f'/run/user/{os.getuid()}')
    try:
        _check(runtime)
        return _make_folder(runtime / NAME)
    except OSError:
        return _make_folder(Path(tempfile.gettempdir()) / f'{NAME}_{os.getuid()}')


class HeldError(Exception):
    """A lock is held by another process; the text is its id, or ''."""


class Lock:
    """
    A named lock of this process, until :meth:`close` or the end of the process.

    :meth:`close` removes its file. The file of a killed process remains until the name is used
    again.

    Raises:
        HeldError: another process holds the lock.
        OSError: as :func:`open_lock`.

    """

    def __init__(self, name: str):
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
            raise OSError(f'{folder() / name}: was removed repeatedly, cannot be used as a lock')
        self._file.truncate(0)
        self._file.write(str(os.getpid()))
        self._file.flush()

    def close(self) -> None:
        """Release the lock; remove its file, and the folder if it is empty."""
        if not self._file.closed:
            if self._is_in_place():
                self._path.unlink(missing_ok=True)
            self._file.close()
            _remove_if_empty(self._path.parent)

    def _is_in_place(self):
        """Whether the locked file is still the one under this name."""
        try:
            return os.path.samestat(os.lstat(self._path), os.fstat(self._file.fileno()))
        except OSError:
            return False


def remove_stale_locks(pattern: str) -> None:
    """Remove the files of released locks; only for names that no process takes meanwhile."""
    for path in folder().glob(pattern):
        try:
            Lock(path.name).close()
        except (HeldError, OSError):
            pass


def open_lock(name: str):
    """
    Open a file of :func:`folder` for locking, without truncation and without following links.

    Raises:
        OSError: no folder, or the file is a link, special, or of another user.

    """
    for left in reversed(range(ATTEMPTS)):
        try:
            return _open(name)
        except FileNotFoundError:       # its last user has just removed the folder
            if not left:
                raise


def _open(name):
    place = folder()
    parent = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        _check_access(os.fstat(parent), place)  # the opened folder: its name may change meanwhile
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


def process_folder(name: str) -> Path:
    """
    Make a folder that is removed with this process; remove those of killed processes.

    Raises:
        OSError: the folder cannot be made.

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
    _remove_if_empty(made.parent)


def _remove_if_empty(place):
    """Remove the folder if it is empty."""
    try:
        place.rmdir()
    except OSError:
        pass


def _make_folder(path):
    """Make the folder if it is missing; return the checked path."""
    try:
        path.mkdir(mode=0o700)
    except FileExistsError:
        pass
    _check(path)
    return path


def _check(path):
    _check_access(os.lstat(path), path)


def _check_access(found, path):
    """Refuse anything but a folder of this user that is closed to others."""
    if not stat.S_ISDIR(found.st_mode):
        raise OSError(f'{path}: expected a folder, found a link or file; remove it')
    if found.st_uid != os.getuid():
        raise OSError(f'{path}: belongs to user {found.st_uid}, expected {os.getuid()}; remove it '
                      'or set XDG_RUNTIME_DIR')
    if found.st_mode & 0o077:
        raise OSError(f'{path}: open to other users (mode {stat.S_IMODE(found.st_mode):o}), '
                      f'expected 700; chmod 700 {path}')
