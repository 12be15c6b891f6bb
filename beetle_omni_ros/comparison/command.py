"""`beetle_omni compare`: flies every experiment with several controllers and writes the page."""

from dataclasses import replace
from pathlib import Path
import platform
import sys

import joblib
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.comparison import page
from beetle_omni_ros.comparison.flights import CONDITIONS, fly_flight, plan, TASKS
from beetle_omni_ros.comparison.summary import summarise
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.evaluation.campaign import (
    check_backend,
    commit,
    file_digest,
    policy_file,
    Store,
    sweep,
    versions,
)
from beetle_omni_ros.pages.page import print_grids, Terminal
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.files import write_json, write_text
from beetle_omni_ros.runs.metrics import failed

PAGE, NUMBERS, TEXT = 'comparison.html', 'comparison.json', 'README.md'
HOW = '../how-to/comparison.md'     # link from a folder in docs/
WIDE = 120  # columns of a terminal that shows the published numbers
FLIGHTS = '.flights'  # default folder of finished flights, in the output folder


def run_compare(*, output: Path, controllers: list[str] | None = None,
                tasks: list[str] | None = None, conditions: list[str] | None = None,
                seeds: list[int] | None = None, jobs: int | None = None,
                backend: str = 'processes', address: str | None = None,
                cache: Path | None = None, policy: Path | None = None,
                plant: Path | None = None, readme: Path | None = None,
                json_path: Path | None = None, console: Console | None = None) -> dict:
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
    names = controllers or registry.COMPARED
    arguments = (names, tasks or TASKS, conditions or CONDITIONS, seeds)
    check_backend(backend)
    if readme:
        page.parted(readme)     # refuses a file without the place
    if plant:
        RobotParameters.load(plant)
    plan(*arguments)  # refuses unusable input before any work
    available, skipped = _available(names, policy, refuse=controllers is not None)
    for name, reason in skipped.items():
        print(f'beetle_omni: {name} is left out: {reason}', file=sys.stderr)
    flights = plan([entry.reference for entry in available], *arguments[1:], policy=policy,
                   plant=plant)
    output = Path(output)
    store = Store(cache or output / FLIGHTS)
    try:
        output.mkdir(parents=True, exist_ok=True)
        made = sweep(fly_flight, [(flight, flight.make_task()) for flight in flights],
                     store=store, backend=backend, jobs=jobs, address=address, console=console,
                     line=_line)
    except KeyboardInterrupt:
        print(f'beetle_omni: finished flights are kept in {store.folder}; the same command '
              'continues from there', file=sys.stderr)
        raise
    except OSError as error:
        raise ParameterError(f'{output}: cannot write there ({error.strerror})') from None
    flown = dict(zip(flights, made, strict=True))
    results = results_of(flown, arguments, [entry.name for entry in available], skipped, policy,
                         plant)
    results['meta']['guidance'] = {entry.name: text for entry, text in available.items()}
    write(results, flown, output, console)
    if readme:
        write_text(readme, page.with_table(readme, results), '--readme')
    write_json(json_path, results)
    return results


def _available(names, policy, refuse):
    """
    Build each controller once, which also fills the cache of compiled code for the workers.

    Returns the entries that can fly with the text of their guidance, and the reason for each
    other one. With ``refuse`` the first reason is raised instead.
    """
    robot, available, skipped = RobotParameters.load(), {}, {}
    learnt = registry.OWNER['--policy']
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


def results_of(flown: dict, arguments: tuple, names: list[str], skipped: dict,
               policy: Path | None = None, plant: Path | None = None) -> dict:
    """Content of the JSON file, from plain values, so that it is equal after reading."""
    _, tasks, conditions, seeds = arguments
    order = {name: k for k, name in enumerate((*tasks, *conditions, *names))}
    flights = sorted(flown, key=lambda flight: (
        order[flight.task], order[flight.conditions], order[flight.controller], flight.seed))
    specs = {flight.controller: flight.spec for flight in flights if flight.spec}
    references = [specs.get(name, name) for name in names]
    files = {flight.controller: policy_file(flight.reference, flight.policy)
             for flight in flights}
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
                 'plant': str(plant) if plant else None,
                 'policies': {name: f'{files[name].name} ({file_digest(files[name])})'
                              for name in names if files[name]},
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


def write(results: dict, flown: dict, output: Path, console: Console) -> None:
    """Write page, pictures, text and numbers, and print the table of all experiments."""
    controllers = results['meta']['controllers']
    sections = page.sections(results, {flight: flown[flight] for flight in sorted(
        flown, key=lambda flight: (controllers.index(flight.controller), flight))})
    for picture in page.pictures(sections):
        (output / f'{picture.name}.png').write_bytes(picture.data)
    write_text(output / PAGE, page.as_page(results, sections), 'page')
    write_text(output / TEXT, page.as_markdown(
        results, sections, HOW if (output / HOW).is_file() else ''), 'page')
    write_json(output / NUMBERS, results)
    glance = page.glance(results)
    if console.width < WIDE:
        shown = [k for k in range(len(glance.header)) if k not in glance.faint_columns]
        glance = replace(glance, header=[glance.header[k] for k in shown], rows=[
            [row[k] for k in shown] for row in glance.rows], faint_columns=frozenset())
    print_grids([glance], console)
    broken = sum(bool(result['failure']) for result in flown.values())
    if broken:
        console.print(f'{broken} of {len(flown)} flights failed, see above and on the page',
                      style='red', highlight=False)
    console.print(f'{output / PAGE}', highlight=False)
