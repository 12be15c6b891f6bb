"""`beetle_omni improve`: from flights to a corrected robot file, and both controllers with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from beetle_omni_ros.options import (
    JobsOption,
    PlantOption,
    SeedOption,
    several,
    TaskOption,
    TheRobotOption,
)


def improve(runs: Annotated[list[Path], Argument(metavar='RUN...', help=(
                'Recorded flights, as of gap.'))],
            output: Annotated[Path, Option(metavar='DIR', help=(
                'Folder of verdict, corrected robot file, flights and page. The same command '
                'continues.'))],
            holdout: Annotated[list[Path], Option(metavar='RUN...', help=(
                'Flights for validation only. Default: the last of three bags or more.'))] = (),
            robot: TheRobotOption = None,
            plant: PlantOption = None,
            controllers: Annotated[str, Option(
                '--controllers', '--controller', callback=several, metavar='NAME,...',
                help='Controllers that fly with both files.')] = 'nmpc,rl',
            task: TaskOption = 'random10',
            flights: Annotated[int, Option(min=1, metavar='N', help=(
                'Flights of each controller with each file.'))] = 3,
            seed: SeedOption = 0,
            jobs: JobsOption = None,
            alpha: Annotated[float, Option(metavar='P', help=(
                'Accepted probability of a false alarm.'))] = 0.05):
    """
    Find what the model lacks, and fly every controller with the corrected robot file.

    After the verdict 'named', policy and NMPC fly the task with the file before and with the
    corrected one, on the plant or, without it, on the corrected robot.
    Example: beetle_omni improve flight1 flight2 flight3 --output improved
    """
    from beetle_omni_ros.identify.flights.command import gap_results
    from beetle_omni_ros.model.files import write_json, write_text
    from beetle_omni_ros.show import page
    console, corrected = page.Terminal(), output / 'robot.yaml'
    output.mkdir(parents=True, exist_ok=True)
    found = gap_results(runs, holdout, robot, corrected, output / 'gap.json', output / 'gap.html',
                        console, alpha=alpha)
    results: dict = {'verdict': found['verdict'], 'controllers': {}}
    if found['effects']:
        from beetle_omni_ros.flight import improve as flown
        results['controllers'] = flown.before_and_after(
            robot, corrected, plant, controllers, task, range(seed, seed + flights),
            output / 'flights', jobs, console)
        grid = flown.improvement_grid(results['controllers'], (
            f'{task}, {flights} flights, plant: {plant or corrected}'))
        said = flown.conclusions(results['controllers'])
        page.print_grids([grid], console)
        console.print('\n'.join(said), highlight=False, markup=False)
        write_text(output / 'improve.html', page.page(
            'Before and after', found['summary'], [grid], said, []), 'page')
    else:
        console.print(f"verdict {found['verdict']}: there is nothing to fly with",
                      highlight=False)
    write_json(output / 'improve.json', results)
    shown = output / ('improve.html' if found['effects'] else 'gap.html')
    page.print_end(console, [shown, output / 'improve.json'], f'open {shown} in a browser')
    return 3 if found['verdict'] == 'bad_data' else 0
