"""Playback of recorded runs over each other."""

import threading

import numpy as np

from beetle_omni_ros.view.frames import COLUMNS, state_at, T
from beetle_omni_ros.view.page import AHEAD, BEHIND, moments, Page, RATE, Shown
from beetle_omni_ros.view.recording import Recording

SPEEDS = {'x 1/4': 0.25, 'x 1/2': 0.5, 'x 1': 1.0, 'x 2': 2.0, 'x 5': 5.0, 'x 10': 10.0}
SLIDER_PERIOD = 0.2     # [s] between moves of the slider by the player itself


class Player:
    """
    Plays recordings on a page.

    The time is that of the first recording, from its beginning. The others are shifted so that
    all tasks begin together.

    Args:
        page: page with a name for each recording.
        recordings: recordings with at least one row each.
        start: start of the playback [s].
        play: whether playback starts at once.

    """

    def __init__(self, page: Page, recordings: list[Recording], start: float = 0.0,
                 play: bool = True):
        self._page, self._runs = page, recordings
        self.time, self._stop = start, threading.Event()
        gui = page.server.gui
        with page.controls:
            self._slider = gui.add_slider('time [s]', 0.0, max(self.length, 0.1), 0.01,
                                          min(start, self.length))
            self._play = gui.add_checkbox('play', play)
            self._speed = gui.add_dropdown('speed', tuple(SPEEDS), initial_value='x 1')
        self._slider.on_update(self._on_slider)
        self._play.on_update(self._on_play)
        self._drawn: dict[int, int] = {}
        self._renew = True

    @property
    def length(self) -> float:
        """Duration of the first run, as far as it was read, rounded to the slider's step [s]."""
        times = self._runs[0].rows.times
        return round(float(times[-1] - times[0]), 2)

    def _on_slider(self, event):
        if event.client is not None:    # not the player itself
            self.time, self._renew = float(self._slider.value), True

    def _on_play(self, _):
        if self._play.value and self.time >= self.length - 1 / RATE:
            self.time = 0.0

    def run(self) -> None:
        """Play until :meth:`stop`."""
        moved = 0.0
        for now, passed in moments(self._stop):
            playing = self._play.value
            if playing:
                self.time = min(self.time + passed * SPEEDS[self._speed.value], self.length)
                if self._runs[0].done and self.time >= self.length:
                    self._play.value = False
            if playing or self._renew or self._page.settling:
                if self._renew:
                    self._page.refresh()
                self._renew = False
                self.draw(passed if playing else 0.0)
            if now - moved > SLIDER_PERIOD:
                moved = now
                self._follow(playing)

    def stop(self) -> None:
        """End :meth:`run`."""
        self._stop.set()

    def draw(self, passed: float = 0.0) -> None:
        """Draw the present moment."""
        first = self._runs[0]
        begin = float(first.rows.times[0])
        shown = []
        for run in self._runs:
            # Between the run's own clock and the time base of the page.
            shift = run.origin() - (first.origin() - begin)
            at = self.time + shift
            window = run.rows.window(at - BEHIND, at + AHEAD).copy()
            window[:, T] -= shift
            shown.append(Shown(run.rows.at(at), window, state_at(run.states, at),
                               {name: t for name, t in run.faults.items() if t <= at}))
        total = f'{self.length:.0f}' if first.done else f'{self.length:.0f}, reading'
        self._page.show(shown, self.time, passed, f'{first.name}: {self.time:.1f} s of {total}')

    def _follow(self, playing):
        """Update the slider by the playback, and slider range and paths by newly read data."""
        if self.length > self._slider.max:
            self._slider.max = self.length
        if playing:
            self._slider.value = self.time
        for k, run in enumerate(self._runs):
            if len(run.rows) > 1.5 * self._drawn.get(k, 0) or run.done and \
                    len(run.rows) > self._drawn.get(k, 0):
                self._drawn[k], self._renew = len(run.rows), True
                self._page.draw_trail(k, run.rows.table[:, COLUMNS['position']])

    def look(self) -> None:
        """Set the initial camera so that the flight, as far as it was read, is visible."""
        positions = np.concatenate([run.rows.table[:, COLUMNS['position']]
                                    for run in self._runs])
        low, high = positions.min(axis=0), positions.max(axis=0) + [0, 0, 0.3]
        self._page.look_at((low + high) / 2, float(np.linalg.norm(high - low)))
