"""`beetle_omni view RUN...`: playback of recorded runs in the browser."""

from contextlib import ExitStack, suppress
from pathlib import Path

from rich.console import Console

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.runs.bag_files import names_of, runs_in
from beetle_omni_ros.view.recording import Recording

FIRST_ROWS = 60.0       # [s] timeout for the first rows of a run


def names(paths: list[Path]) -> list[str]:
    """Return distinct names of runs: their folders, if necessary with the folders above."""
    found = names_of(paths)
    if len(set(found)) == len(found):
        return found
    return [f'{name} ({k + 1})' for k, name in enumerate(found)]


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
        for path, name in zip(runs, names(runs), strict=True):
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
