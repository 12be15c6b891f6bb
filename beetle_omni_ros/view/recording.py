"""Recorded runs in the browser, read by a process each while their first seconds are shown."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
import os
from pathlib import Path
import pickle
import subprocess
import sys
import threading
from typing import NamedTuple

import numpy as np
from rich.console import Console

import beetle_omni_ros
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.runs.bag import bag_files, BagError, names_of, no_pose, runs_in
from beetle_omni_ros.view.frames import COLUMNS, Rows, Sampler

STEP = 0.02         # [s] between rows
GAP = 1.0           # [s] without any message in which no rows are made
PART = 1000         # rows that are passed on together, after a shorter first part
SKIPPED = ('imu/data_raw', 'mocap/pose', 'rotor_states')
FIRST_ROWS = 60.0       # [s] timeout for the first rows of a run


class Part(NamedTuple):
    """
    New data of a run.

    Attributes:
        rows: (N, WIDTH) rows, see :mod:`~beetle_omni_ros.view.frames`.
        states: (t, state) of the supervisor so far.
        faults: name -> time of the first report [s].
        meta: metadata of the run, in the last part.
        warnings: missing and unusable data, in the last part.
        error: why the bag is unreadable, or ''.

    """

    rows: np.ndarray
    states: Sequence[tuple[float, str]] = ()
    faults: Mapping[str, float] = {}
    meta: Mapping = {}
    warnings: Sequence[str] = ()
    error: str = ''


def parts(path: str | Path) -> Iterator[Part]:
    """
    Read a bag in parts; the first one is short, the first chunk of the file.

    Raises:
        BagError: the bag is unreadable, or contains no pose of the robot.

    """
    from beetle_omni_ros.runs.bag import replay  # 0.1 s, not needed by the page
    sampler, warnings, size = Sampler(), [], 0
    tables, due = [], None
    for times in replay(path, sampler, warnings, leave_out=SKIPPED):
        if not len(times):
            continue
        times = np.sort(times)
        if due is None or not due - GAP < times[0] < due + GAP:
            due = times[0]
        grid = due + STEP * np.arange(np.ceil(max(0.0, times[-1] - due) / STEP))
        grid = grid[grid < times[-1]]
        if len(grid):
            due = grid[-1] + STEP
        following = times[np.searchsorted(times, grid)]
        rows = sampler.rows(grid[following - grid < GAP])
        tables.append(rows[~np.isnan(rows[:, COLUMNS['position']]).any(axis=1)])
        if sum(map(len, tables)) > size:
            yield Part(np.concatenate(tables), list(sampler.states), dict(sampler.faults))
            tables, size = [], PART
    if not sampler.placed:
        raise no_pose(path, warnings)
    yield Part(np.concatenate([Rows().table, *tables]), list(sampler.states),
               dict(sampler.faults), dict(sampler.meta), warnings)


class Recording:
    """
    A run that is being read.

    Attributes:
        name: name for labels.
        rows: rows so far.
        states, faults, meta, warnings: as in :class:`Part`, so far.
        done: whether the whole run was read.

    """

    def __init__(self, path: str | Path, name: str | None = None):
        """
        Start reading.

        Raises:
            BagError: no such bag.

        """
        bag_files(path)
        self.path, self.name = Path(path), name or Path(path).absolute().name
        self.rows = Rows()
        self._take(Part(self.rows.table))
        self.done = False
        self._changed = threading.Condition()
        root = str(Path(beetle_omni_ros.__file__).resolve().parents[1])
        self._process = subprocess.Popen(
            [sys.executable, '-m', __name__, str(path)], stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL, env=dict(os.environ, PYTHONPATH=os.pathsep.join(
                filter(None, [root, os.environ.get('PYTHONPATH')]))))
        threading.Thread(target=self._take_in, daemon=True).start()

    def wait(self, timeout: float | None = None, whole: bool = False) -> None:
        """
        Wait for the first rows, or for the whole run.

        Raises:
            BagError: the bag is unreadable.

        """
        with self._changed:
            self._changed.wait_for(lambda: self.done or (len(self.rows) and not whole), timeout)
        if self._error:
            raise BagError(self._error)

    def origin(self) -> float:
        """Return the time of the first state 'flying', else of the first row [s]."""
        flying = (t for t, state in self.states if state.startswith('flying'))
        return next(flying, float(self.rows.times[0]))

    def close(self) -> None:
        """Stop reading."""
        self._process.kill()
        self._process.wait()

    def _take(self, part):
        rows, self.states, self.faults, self.meta, self.warnings, self._error = part
        self.rows.append(rows)

    def _take_in(self):
        try:
            while True:
                part = pickle.load(self._process.stdout)
                with self._changed:
                    self._take(part)
                    self._changed.notify_all()
        except (EOFError, pickle.UnpicklingError, OSError):
            if not len(self.rows) and not self._error:
                self._error = f'{self.path}: the process that reads it ended'
        with self._changed:
            self.done = True
            self._changed.notify_all()


def main(path: str) -> None:
    """Read a bag and write its parts to standard output."""
    output = sys.stdout.buffer
    try:
        for part in parts(path):
            pickle.dump(part, output)
            output.flush()
    except BagError as error:
        pickle.dump(Part(Rows().table, error=str(error)), output)
    except (BrokenPipeError, KeyboardInterrupt):
        os._exit(1)     # the reader has ended; a regular exit would report the closed output


if __name__ == '__main__':
    # Import again: pickled classes must belong to this module, not to __main__.
    from beetle_omni_ros.view import recording
    recording.main(sys.argv[1])


def run_view(runs: list[Path], *, robot: Path | None = None, urdf: Path | None = None,
             host: str, port: int, dark: bool = False, start: float = 0.0,
             play: bool = True, console: Console | None = None) -> None:
    """
    Play recorded runs until Ctrl-C; arguments are the options of `beetle_omni view`.

    Raises:
        BagError: unusable run.
        ParameterError: other unusable input.

    """
    console, runs = console or Console(), runs_in(runs)
    model, parameters = Model.load(urdf), RobotParameters.load(robot)
    with ExitStack() as stack:
        recordings = []
        for path, name in zip(runs, names_of(runs), strict=True):
            recordings.append(Recording(path, name))
            stack.callback(recordings[-1].close)
        from beetle_omni_ros.view.page import Page  # slow import, while the first rows are read
        from beetle_omni_ros.view.playback import Player
        page = Page([recording.name for recording in recordings], model, parameters, host=host,
                    port=port, dark=dark)
        stack.callback(page.close)
        for recording in recordings:
            recording.wait(FIRST_ROWS)
        player = Player(page, recordings, start, play)
        player.look()
        player.draw()
        with suppress(KeyboardInterrupt):       # the regular end
            announce(page.url, console)
            player.run()


def announce(url: str, console: Console) -> None:
    """Print the address of the page."""
    console.print(f'{url}  (Ctrl-C ends it)', markup=False, highlight=False, soft_wrap=True)
