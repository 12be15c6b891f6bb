"""`beetle_omni film`: draws recorded flights as a film."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from beetle_omni_ros.film.files import FORMATS, write_film
from beetle_omni_ros.film.frames import frames
from beetle_omni_ros.film.free_runs import free_runs
from beetle_omni_ros.film.scenes import model_scene, Scene, target_scene
from beetle_omni_ros.pages.figures import COLOURS
from beetle_omni_ros.pages.table import Terminal
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.bag_files import no_pose, runs_in
from beetle_omni_ros.runs.log import FlightLog

MAX_PANELS = 4
MODEL_COLOURS = (COLOURS[1], COLOURS[2], COLOURS[0], COLOURS[3])


def run_film(paths: list[Path], outputs: list[Path], *, models: list[Path] = (),
             robot: Path | None = None, start: float = 0.0, duration: float | None = None,
             speed: float = 1.0, size: int = 440, console: Console | None = None) -> None:
    """
    Draw flights side by side.

    The arguments are those of `beetle_omni film`. With ``models`` there must be one path.

    Raises:
        BagError: a run cannot be read.
        ParameterError: unusable arguments or files.

    """
    console, paths = console or Terminal(), runs_in(paths)
    _check(paths, outputs, models, size, start, duration)
    drawn = RobotParameters.load(robot)
    logs = [_read(path) for path in paths]
    starts = [(log.targets[0].stamp if log.targets else log.start) + start for log in logs]
    longest = max(log.end - begin for log, begin in zip(logs, starts, strict=True))
    length = longest if duration is None else min(duration, longest)
    if not length > 0:
        raise ParameterError(f'--start {start:g}: expected a time before the end of the flight, '
                             f'{longest + start:.1f} s')
    expected = [(file.stem.replace('_', ' '), free_runs(logs[0], RobotParameters.load(file)))
                for file in models]
    for output in outputs:
        fps = FORMATS[output.suffix]
        times = np.arange(0.0, length, speed / fps)
        scenes: list[Scene]
        if models:
            scenes = [model_scene(logs[0], label, colour, starts[0] + times, motion)
                      for (label, motion), colour in zip(expected, MODEL_COLOURS)]
        else:
            names = [Path(path).absolute().name for path in paths]
            scenes = [target_scene(log, name, colour, begin + times, drawn) for
                      log, name, colour, begin in zip(logs, names, COLOURS, starts)]
        pictures = frames(scenes, times, drawn, size)
        write_film(output, track(pictures, output.name, total=len(times), console=console,
                                 transient=True), fps)
        console.print(f'{output}: {len(times) / fps:.0f} s, '
                      f'{output.stat().st_size / 1e6:.1f} MB', highlight=False)


def _check(paths, outputs, models, size, start, duration):
    if not np.isfinite(start):
        raise ParameterError(f'--start {start}: expected seconds')
    if duration is not None and not 0 < duration < np.inf:
        raise ParameterError(f'--duration {duration:g}: expected more than 0 s')
    for output in outputs:
        if output.suffix not in FORMATS:
            raise ParameterError(f"{output}: expected a name that ends with "
                                 f"{' or '.join(FORMATS)}")
    if max(len(paths), len(models)) > MAX_PANELS:
        raise ParameterError(f'{max(len(paths), len(models))} panels; a film has at most '
                             f'{MAX_PANELS}')
    if models and len(paths) > 1:
        raise ParameterError(f'--model: expected one RUN with it, found {len(paths)}')
    if size % 2:
        raise ParameterError(f'--size {size}: expected an even number of pixels')


def _read(path: Path) -> FlightLog:
    log = read_bag(path)
    if not len(log.truth_t) and not len(log.odom_t):
        raise no_pose(path, log.warnings)
    return log
