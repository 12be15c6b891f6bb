"""Flights with a corrected robot file beside those with the file before."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from beetle_omni_ros.flight.campaign import Store, sweep
from beetle_omni_ros.flight.compare import ComparedFlight, fly_flight
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.show.page import Grid, number

FILES = 'before', 'after'
# Result -> label, factor of its unit, digits.
ERRORS = {'U_position_m': ('U position, mean [mm]', 1e3, 2),
          'U_orientation_deg': ('U orientation, mean [deg]', 1.0, 2),
          'L_position_m': ('L position, mean [mm]', 1e3, 1),
          'L_orientation_deg': ('L orientation, mean [deg]', 1.0, 2)}
WORSE = 0.05        # [1] increase of an error with which a file is not recommended
CERTAIN = 1.645     # standard errors of the mean: 95 %, one-sided


def before_and_after(robot: Path | None, corrected: Path, plant: Path | None,
                     controllers: Sequence[str], task: str, seeds: Sequence[int],
                     folder: Path, jobs: int | None = None,
                     console: Console | None = None) -> dict:
    """
    Fly controllers with a robot file and with the corrected one on the same plant.

    Arguments are as of `beetle_omni improve`; one flight for each of ``seeds``. ``folder`` keeps
    finished flights, so that a repeated call flies the rest.

    Returns:
        controller -> 'before' and 'after' with reached, poses and the means of ``ERRORS``,
        'ratio' of each error, 'worse': the errors that are more than 5 % larger with 95 %
        certainty, by the differences of the poses, and 'better': none is, and no pose is lost.

    """
    poses: dict[str, dict[str, list]] = {name: {} for name in controllers}
    for file, path in zip(FILES, (str(robot or ''), str(corrected)), strict=True):
        flights = [ComparedFlight(task, 'nominal', name, seed, plant=str(plant or corrected),
                                  robot=path) for seed in seeds for name in controllers]
        flown = sweep(fly_flight, [(flight, flight.make_task()) for flight in flights],
                      store=Store(folder / file), jobs=jobs, console=console)
        for flight, result in zip(flights, flown, strict=True):
            if result['failure']:
                raise RunError(f"{flight.name}: {result['failure']}")
            poses[flight.controller].setdefault(file, []).extend(result['metrics']['poses'])
    return {name: compared(each) for name, each in poses.items()}


def compared(poses: dict[str, list[dict]]) -> dict:
    """Summary of the poses flown with each of ``FILES``; see :func:`before_and_after`."""
    made: dict = {file: {'reached': sum(pose['reached'] for pose in flown), 'poses': len(flown),
                         **{key: mean([pose[key] for pose in flown]) for key in ERRORS}}
                  for file, flown in poses.items()}
    before, after = (made[file] for file in FILES)
    made['ratio'] = {key: after[key] / before[key] if before[key] and after[key] else None
                     for key in ERRORS}
    made['worse'] = [key for key in ERRORS if is_worse(*(
        [pose[key] for pose in poses[file]] for file in FILES))]
    made['better'] = after['reached'] >= before['reached'] and not made['worse']
    return made


def is_worse(before: list[float | None], after: list[float | None]) -> bool:
    """Whether an error certainly increases by more than ``WORSE``, over poses of both flights."""
    pairs = np.array([pair for pair in zip(before, after, strict=True) if None not in pair])
    if not len(pairs):
        return True         # nothing shows that it does not
    more = pairs[:, 1] - (1 + WORSE) * pairs[:, 0]
    spread = more.std(ddof=1) if len(more) > 1 else 0.0
    return bool(more.mean() > CERTAIN * spread / np.sqrt(len(more)))


def mean(values: list[float | None]) -> float | None:
    """Mean of the poses that were flown; None without any."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def improvement_grid(results: dict, title: str) -> Grid:
    """Table of :func:`before_and_after`."""
    rows = [['poses reached', *(f"{made[file]['reached']} of {made[file]['poses']}"
                                for made in results.values() for file in FILES)]]
    for key, (label, factor, digits) in ERRORS.items():
        rows.append([label, *(
            number(made[file][key] if made[file][key] is None else factor * made[file][key],
                   digits) for made in results.values() for file in FILES)])
    return Grid(title, ['', *(f'{name}, {file}' for name in results for file in FILES)], rows)


def conclusions(results: dict) -> list[str]:
    """One sentence for each controller."""
    made = []
    for name, found in results.items():
        worse = [ERRORS[key][0].partition(',')[0] for key in found['worse']]
        lost = found['before']['reached'] - found['after']['reached']
        reasons = [*([f'{lost} more poses are missed'] if lost > 0 else []),
                   *([f"{' and '.join(worse)} {'is' if len(worse) == 1 else 'are'} more than 5 % "
                      'larger'] if worse else [])]
        made.append(f'{name} flies better with the corrected file, or as well.' if found['better']
                    else f"{name} stays with the file before: {', and '.join(reasons)}.")
    return made
