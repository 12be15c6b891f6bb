"""`beetle_omni compare`: flies every experiment with several controllers and writes the page."""

from pathlib import Path
import platform
import sys

import joblib
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from beetle_omni_ros import __version__
from beetle_omni_ros.comparison import grids, page
from beetle_omni_ros.comparison.fingerprint import commit, file_digest, policy_file, versions
from beetle_omni_ros.comparison.grid import Grid, Number
from beetle_omni_ros.comparison.plan import CONDITIONS, Flight, plan, TASKS
from beetle_omni_ros.comparison.style import look
from beetle_omni_ros.comparison.summary import summarise
from beetle_omni_ros.comparison.sweep import check_backend, Store, sweep
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.pages.table import Terminal
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.json_file import write_json
from beetle_omni_ros.runs.metrics import failed

PAGE, NUMBERS, TEXT = 'comparison.html', 'comparison.json', 'README.md'
HOW = '../how-to/comparison.md'     # link from a folder in docs/
WIDE = 120  # columns of a terminal that shows the published numbers
FLIGHTS = '.flights'  # default folder of finished flights, in the output folder


def run_compare(*, output: Path, controllers: list[str] | None = None,
                tasks: list[str] | None = None, conditions: list[str] | None = None,
                seeds: list[int] | None = None, jobs: int | None = None,
                backend: str = 'processes', address: str | None = None,
                cache: Path | None = None, fresh: bool = False, policy: Path | None = None,
                plant: Path | None = None, json_path: Path | None = None,
                console: Console | None = None) -> dict:
    """
    Fly the missing flights, then write page, pictures and numbers.

    Arguments are the options of `beetle_omni compare`; None is their default.

    Returns:
        content of ``comparison.json``.

    Raises:
        ParameterError: unusable input.
        RunError: a worker was lost.

    """
    console = console or Terminal()
    names = controllers or registry.compared()
    arguments = (names, tasks or TASKS, conditions or CONDITIONS, seeds)
    check_backend(backend)
    if plant:
        RobotParameters.load(plant)
    plan(*arguments)  # refuses unusable input before any work
    available, skipped = _available(names, policy, refuse=controllers is not None)
    for name, reason in skipped.items():
        print(f'beetle_omni: {name} is left out: {reason}', file=sys.stderr)
    flights = plan([entry.reference for entry in available], *arguments[1:], policy=policy,
                   plant=plant)
    output = Path(output)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'{output}: cannot write there ({error.strerror})') from None
    store = Store(cache or output / FLIGHTS)
    try:
        flown = _fly(flights, store, console, backend=backend, jobs=jobs, fresh=fresh,
                     address=address)
    except KeyboardInterrupt:
        print(f'beetle_omni: finished flights are kept in {store.folder}; the same command '
              'continues from there', file=sys.stderr)
        raise
    results = _results(flown, arguments, [entry.name for entry in available], skipped, policy,
                       plant)
    results['meta']['guidance'] = {entry.name: text for entry, text in available.items()}
    _write(results, flown, output, console)
    write_json(json_path, results)
    return results


def _available(names, policy, refuse):
    """
    Build each controller once, which also fills the cache of compiled code for the workers.

    Returns the entries that can fly with the text of their guidance, and the reason for each
    other one. With ``refuse`` the first reason is raised instead.
    """
    robot, available, skipped = RobotParameters.load(), {}, {}
    learnt = registry.owner('--policy')
    for entry in registry.find_all(names):
        try:
            available[entry] = guidance_of(entry.make(robot, ControllerOptions(
                policy=policy if entry.name == learnt else None)))
        except (ParameterError, FileNotFoundError) as error:
            if refuse:
                raise ParameterError(str(error)) from None
            skipped[entry.name] = ' '.join(str(error).split())
    if policy and learnt not in {entry.name for entry in available}:
        raise ParameterError(f"--policy {policy}: for the controller '{learnt}', which does not "
                             'fly')
    return available, skipped


def _fly(flights, store, console, **options):
    columns = (SpinnerColumn(), TextColumn('{task.description}'), BarColumn(),
               TimeElapsedColumn(), TextColumn('left'), TimeRemainingColumn())
    count = {'done': 0}
    with Progress(*columns, console=console, transient=True,
                  speed_estimate_period=1200) as progress:
        bar = progress.add_task('', total=sum(flight.cost for flight in flights))

        def done(flight, result, kept):
            count['done'] += 1
            progress.update(bar, advance=flight.cost,
                            description=f"{count['done']} of {len(flights)} flights")
            progress.console.print(_line(flight, result, kept), highlight=False,
                                   style='red' if result['failure'] else 'dim' if kept else None)

        progress.update(bar, description=f'0 of {len(flights)} flights')
        return sweep(flights, store=store, done=done, **options)


def _line(flight, result, kept):
    if result['failure']:
        return f"{flight.name}: failed, {result['failure']}"
    metrics, parts = result['metrics'], []
    poses = metrics['poses']
    if len(poses) > 1:
        parts.append(f"{sum(pose['reached'] for pose in poses)} of {len(poses)} reached")
    for kind, unit in (('force', 'N'), ('torque', 'N_m')):
        if kind in metrics:
            level = metrics[kind][f'lost_at_{unit}']
            parts.append('control never lost' if level is None else
                         f"control lost at {level:g} {unit.replace('_', ' ')}")
    if failed(metrics):
        parts.append(metrics.get('ended') or 'touched the ground')
    parts.append('kept' if kept else f"{result['cpu_s']:.0f} s")
    return f"{flight.name}: {', '.join(parts)}"


def _results(flown, arguments, names, skipped, policy, plant=None):
    """Content of the JSON file, from plain values, so that it is equal after reading."""
    _, tasks, conditions, seeds = arguments
    order = {name: k for k, name in enumerate((*tasks, *conditions, *names))}
    flights = sorted(flown, key=lambda flight: (
        order[flight.task], order[flight.conditions], order[flight.controller], flight.seed))
    specs = {flight.controller: flight.spec for flight in flights if flight.spec}
    references = [specs.get(name, name) for name in names]
    files = {name: policy_file(reference, policy)
             for name, reference in zip(names, references, strict=True)}
    command = (f"beetle_omni compare --controllers {','.join(references)} "
               f"--tasks {','.join(tasks)} --conditions {','.join(conditions)}"
               + (f" --seeds {','.join(map(str, seeds))}" if seeds else '')
               + (f' --policy {policy}' if policy else '')
               + (f' --plant {plant}' if plant else ''))
    return {
        'meta': {'version': __version__, 'commit': commit(), 'command': command,
                 'controllers': names, 'specs': specs, 'skipped': skipped, 'tasks': list(tasks),
                 'conditions': list(conditions),
                 'seeds': sorted({flight.seed for flight in flights}),
                 'policy_file': str(policy) if policy else None,
                 'plant': str(plant) if plant else None,
                 'policies': {name: f'{file.name} ({file_digest(file)})'
                              for name, file in files.items() if file},
                 'cpu_s': sum(result.get('cpu_s', 0.0) for result in flown.values()),
                 'machine': {'processor': _processor(), 'cores': joblib.cpu_count(),
                             'system': f'{platform.system()} {platform.machine()}'},
                 'versions': versions()},
        'summary': summarise({flight: flown[flight] for flight in flights}),
        'flights': [{'task': flight.task, 'conditions': flight.conditions,
                     'controller': flight.controller, 'seed': flight.seed,
                     **{key: flown[flight].get(key) for key in (
                         'failure', 'cpu_s', 'host', 'metrics')}} for flight in flights]}


def _processor():
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
        return next(line.partition(':')[2].strip() for line in lines if 'model name' in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _write(results, flown, output, console):
    ordered = {flight: flown[flight] for flight in sorted(
        flown, key=lambda flight: (results['meta']['controllers'].index(flight.controller),
                                   flight))}
    made = page.sections(results, ordered)
    how = HOW if (output / HOW).is_file() else ''
    try:
        for picture in page.pictures(made):
            (output / f'{picture.name}.png').write_bytes(picture.data)
        for name, text in ((PAGE, page.page(results, made)),
                           (TEXT, page.markdown(results, made, how))):
            temporary = output / f'{name}.tmp'
            temporary.write_text(text, encoding='utf-8')
            temporary.replace(output / name)
    except OSError as error:
        raise ParameterError(f'{output}: cannot write the page ({error.strerror})') from None
    write_json(output / NUMBERS, results)
    console.print(_rich(grids.glance(results), results, console.width))
    failed = sum(bool(result['failure']) for result in flown.values())
    if failed:
        console.print(f'{failed} of {len(flown)} flights failed, see above and on the page',
                      style='red', highlight=False)
    console.print(f'{output / PAGE}', highlight=False)


def _rich(grid: Grid, results: dict, width: int) -> Table:
    """Table for the terminal, without the published columns if it is narrow."""
    shown = [k for k, column in enumerate(grid.columns)
             if column.group != 'published' or width >= WIDE]
    table = Table(title=grid.title, title_justify='left', title_style='bold', box=None,
                  header_style='dim', padding=(0, 2, 0, 0))
    table.add_column('', ratio=1)
    for column in (grid.columns[k] for k in shown):
        is_ours = column.group != 'published'
        name = look(column.controller).label
        table.add_column(Text(name if is_ours else f'published {name}'), justify='right',
                         style=None if is_ours else 'dim')
    for name, cells in grid.rows:
        table.add_row(Text(name), *(Text(''.join(
            part.text(results) if isinstance(part, Number) else part
            for part in [*cells[k].main, *cells[k].small])) for k in shown))
    return table


__all__ = ['Flight', 'run_compare']
