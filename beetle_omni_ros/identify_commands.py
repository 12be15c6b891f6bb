"""Subcommands that correct a robot file: `gap`, `improve` and those of `identify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from beetle_omni_ros import options


def gap(runs: Annotated[list[Path], Argument(metavar='RUN...', help=(
            'Recorded flights: bags, or with --format tables; or logs of the joints (CSV, or bags '
            'with only joint_states and command).'))],
        holdout: Annotated[list[Path], Option(metavar='RUN...', help=(
            'Flights for validation only. Default: the last of three bags or more.'))] = (),
        robot: options.TheRobotOption = None,
        apply: Annotated[Path | None, Option(callback=options.writable, metavar='FILE', help=(
            'Write a robot file with the named effects.'))] = None,
        page: options.PageOption = None,
        parameters: Annotated[Path | None, Option('--gap', metavar='FILE', help=(
            'File with changes to params/gap.yaml.'))] = None,
        fix: Annotated[bool, Option('--fix', help=(
            'Correct damaged recordings if the correction is certain; the bags stay '
            'unchanged.'))] = False,
        tolerances: Annotated[bool, Option('--tolerances', help=(
            "With --apply: also write this robot's own mass, inertia, gains, lags and rotor "
            'positions, as fitted within tolerance.'))] = False,
        form: Annotated[str | None, Option('--format', metavar='NAME|FILE', help=(
            'Flights are tables (CSV, .gz) with the columns of this format: nanobench, '
            'crazypad_motor, crazyflie_usd, neural_fly, neural_swarm, or a YAML file.'))] = None,
        alpha: Annotated[float, Option(metavar='P', help=(
            'Accepted probability of a false alarm.'))] = 0.05,
        next_task: Annotated[Path | None, Option(
            '--next', callback=options.writable, metavar='FILE', help=(
                'Write a task (YAML) that decides between the candidates, for fly and '
                'evaluate.'))] = None,
        learn: Annotated[Path | None, Option(callback=options.writable, metavar='FILE', help=(
            'Search a formula for what no known effect explains, and write it as an effect '
            '(YAML).'))] = None,
        json_path: options.JsonOption = None):
    """
    Identify and add effects that the model lacks from flights.

    Example: beetle_omni gap flight1 flight2 --holdout flight3 --apply robot_new.yaml
    """
    from beetle_omni_ros.identify.flights.command import gap_results
    experiments = None
    if next_task:
        from beetle_omni_ros.flight.experiment import Experiments as experiments
    return _status(gap_results(
        runs, holdout, robot, apply, json_path, page, parameters=parameters, fix=fix,
        tolerances=tolerances, form=form, alpha=alpha, next_task=next_task, learn=learn,
        experiments=experiments))


def improve(runs: Annotated[list[Path], Argument(metavar='RUN...', help=(
                'Recorded flights, as of gap.'))],
            output: Annotated[Path, Option(metavar='DIR', help=(
                'Folder of verdict, corrected robot file, flights and page. The same command '
                'continues.'))],
            holdout: Annotated[list[Path], Option(metavar='RUN...', help=(
                'Flights for validation only. Default: the last of three bags or more.'))] = (),
            robot: options.TheRobotOption = None,
            plant: options.PlantOption = None,
            controllers: Annotated[str, Option(
                '--controllers', '--controller', callback=options.several, metavar='NAME,...',
                help='Controllers that fly with both files.')] = 'nmpc,rl',
            task: options.TaskOption = 'random10',
            flights: Annotated[int, Option(min=1, metavar='N', help=(
                'Flights of each controller with each file.'))] = 3,
            seed: options.SeedOption = 0,
            jobs: options.JobsOption = None,
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
        from beetle_omni_ros.flight import experiment as flown
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
        for earlier in {corrected, output / 'improve.html'} - {robot, plant}:
            earlier.unlink(missing_ok=True)     # of a run that named something
        console.print(f"verdict {found['verdict']}: there is nothing to fly with",
                      highlight=False)
    write_json(output / 'improve.json', results)
    shown = output / ('improve.html' if found['effects'] else 'gap.html')
    page.print_end(console, [shown, output / 'improve.json'], f'open {shown} in a browser')
    return _status(found)


def _status(results):
    """Exit status by the verdict."""
    return 3 if results['verdict'] == 'bad_data' else 0


identify = options.Commands(help='Fit the actuator models from measured data.')


def _run(what, **options):
    from beetle_omni_ros.identify.command import run_identify
    return run_identify(what, **options)


@identify.command()
def joint(paths: Annotated[list[Path], Argument(metavar='LOG...', help=(
              'Response logs (CSV) or recorded run (bag), see docs/how-to/identification.md.'))],
          validate: Annotated[list[Path], Option(metavar='LOG.csv...', help=(
              'Further logs for validation.'))] = (),
          robot: options.TheRobotOption = None, report: options.PageOption = None,
          params: options.ParamsOption = None, json_path: options.JsonOption = None):
    """
    Fit one servo model to response logs; the last 40 % validate it.

    Several logs of the same servos are fitted together.

    Example: beetle_omni identify joint slow.csv --validate fast.csv --report servos.html
    """
    _run('joint', **locals())


@identify.command()
def rotor(paths: Annotated[list[Path], Argument(metavar='LOG.csv...', help=(
              'Logs of a force-torque stand, see docs/how-to/identification.md.'))],
          columns: Annotated[list[str], Option('--column', metavar='QUANTITY=[-]COLUMN[*FACTOR]',
                                               help=(
              'Column of a quantity with sign and factor to SI units, e.g. thrust=-fz or '
              'thrust=load_g*0.00981; may be repeated.'))] = (),
          rate: options.RateOption = None,
          robot: options.TheRobotOption = None, report: options.PageOption = None,
          params: options.ParamsOption = None, json_path: options.JsonOption = None):
    """
    Fit thrust, torque and lag of a rotor to logs of a stand.

    Ends with status 3 for the verdict bad_data.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    return _status(_run('rotor', **locals()))


@identify.command()
def robot(paths: Annotated[list[Path], Argument(metavar='LOG...', help=(
              'Response logs of the joints (CSV or bag) and logs of a force-torque stand, '
              'recognised by their header.'))],
          params: Annotated[Path, Option(
              callback=options.writable, metavar='FILE', help='The robot file to write.')],
          rate: options.RateOption = None, robot: options.TheRobotOption = None,
          report: options.PageOption = None, json_path: options.JsonOption = None):
    """
    Write a robot file with intervals from logs of servos and rotors.

    Example: beetle_omni identify robot slow.csv fast.csv bench.csv --params my_robot.yaml
    """
    _run('robot', **locals())
