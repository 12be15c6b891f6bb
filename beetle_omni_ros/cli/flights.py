"""Subcommands for flights and their recordings, and the list of controllers."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Optional

import typer

from beetle_omni_ros.cli.options import (
    check_files,
    check_flight,
    CompressionOption,
    CONDITIONS,
    ConditionsOption,
    ControllerOption,
    DiscoveryOption,
    FAILED,
    FaultsOption,
    JobsOption,
    JsonOption,
    KNOWN,
    names,
    NmpcOption,
    numbers,
    OtherRobotOption,
    PlantOption,
    PolicyOption,
    RobotOption,
    SeedOption,
    TaskOption,
)
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions, DEFAULT, owner
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.files import check_writable, write_json


def fly(controller: ControllerOption = DEFAULT,
        task: TaskOption = 'waypoints',
        bag: Annotated[Optional[Path], typer.Option(
            '--bag', metavar='DIR', help='New folder for the recorded bag. Default: '
                                         'runs_out/fly_DATE.')] = None,
        compression: CompressionOption = 'none',
        conditions: ConditionsOption = 'nominal',
        seed: SeedOption = 0,
        actuators: Annotated[Optional[str], typer.Option(
            '--actuators', metavar='emulated|direct',
            help='emulated (default): commands go through joint_bridge_node, rotor_bridge_node, '
                 'serial ports and emulated devices; direct: they go straight to the simulated '
                 'plant.')] = None,
        clock: Annotated[str, typer.Option(
            '--clock', metavar='auto|system|simulated',
            help='system: real time; simulated: simulated time on /clock, which waits for late '
                 'nodes, with direct actuators; auto: simulated if the computer is too slow for '
                 'real time.')] = 'auto',
        robot: RobotOption = None,
        plant: PlantOption = None,
        nmpc_file: NmpcOption = None,
        policy: PolicyOption = None,
        allow_other_robot: OtherRobotOption = False,
        standby: Annotated[bool, typer.Option(
            '--standby/--alone', help='Run the other controllers on standby, to be selected in '
                                      'flight, or only the active controller.')] = True,
        composed: Annotated[bool, typer.Option(
            '--composed/--separate', help='One process for all nodes and one for the bridges, or '
                                          'one process for each node.')] = True,
        faults: FaultsOption = None,
        domain_id: Annotated[Optional[int], typer.Option(
            '--domain-id', min=0, max=101, help='ROS domain. Default: a free one.')] = None,
        discovery: DiscoveryOption = None,
        view: Annotated[bool, typer.Option(
            '--view', help='Show the flight in the browser, as beetle_omni view does.')] = False,
        allow_targets: Annotated[bool, typer.Option(
            '--allow-targets', help='With --view: poses dragged in the page become targets, and '
                                    'controllers can be selected there.')] = False,
        json_path: JsonOption = None):
    """
    Fly the whole ROS graph in real time against the simulated robot.

    Takes off, flies the task, lands, records a bag and prints the result table.
    Example: beetle_omni fly --controller nmpc --task waypoints --bag my_flight
    """
    given, bag = bag, bag or Path('runs_out') / f'fly_{datetime.now():%Y%m%d_%H%M%S}'
    check_flight(task=task, seed=seed, conditions=conditions, bag=bag, compression=compression,
                 json_path=json_path, files=(nmpc_file, policy, faults))
    if allow_targets and not view:
        raise ParameterError('--allow-targets: expected --view with it')
    from beetle_omni_ros.nodes.fly import run_fly
    if not given:
        typer.echo(f'bag: {bag}')
    code = run_fly(controller=controller, task=task, bag=bag, compression=compression,
                   seed=seed, conditions=conditions, actuators=actuators, clock=clock,
                   robot=robot, plant=plant, nmpc=nmpc_file, policy=policy,
                   allow_other_robot=allow_other_robot, standby=standby,
                   composed=composed, faults=faults, json_path=json_path,
                   domain_id=domain_id, discovery=discovery,
                   view=view, allow_targets=allow_targets)
    raise typer.Exit(code if isinstance(code, int) else 0)


def evaluate(controllers: Annotated[str, typer.Option(
                 '--controllers', metavar='NAME,...',
                 help=f'Controllers to fly one after the other: {KNOWN}.')]
             = DEFAULT,
             task: TaskOption = 'random100',
             conditions: ConditionsOption = 'nominal',
             seed: SeedOption = 0,
             robot: RobotOption = None,
             plant: PlantOption = None,
             nmpc_file: NmpcOption = None,
             policy: PolicyOption = None,
             allow_other_robot: OtherRobotOption = False,
             without: Annotated[str, typer.Option(
                 '--without', metavar='LAYER,...',
                 help='Layers of the guidance that are off: unwinding, routing, turning, '
                      'trimming, or all.')] = '',
             bag: Annotated[Optional[Path], typer.Option(
                 '--bag', metavar='DIR', help='New folder for the bag; with several controllers '
                                              'it contains one bag for each.')] = None,
             compression: CompressionOption = 'none',
             faults: FaultsOption = None,
             json_path: JsonOption = None):
    """
    Fly a task in one process, deterministic and without a real-time clock.

    Plant, sensors, estimator, controllers and actuators are those of the ROS graph.
    Example: beetle_omni evaluate --controllers nmpc --task random100 --json result.json
    """
    chosen = names('--controllers', controllers)
    guided = [name for name in chosen if registry.find(name).guidance != 'none']
    if without and not guided:
        raise ParameterError(f'--without {without}: no controller with guidance among '
                             f"{', '.join(chosen)}")
    options = {name: ControllerOptions(allow_other_robot=allow_other_robot,
                                       without=without if name in guided else '')
               for name in chosen}
    for option, file, key in (('--nmpc', nmpc_file, 'parameters'), ('--policy', policy, 'policy')):
        name = owner(option)
        if file and name not in chosen:
            raise ParameterError(f"{option} {file}: for the controller '{name}', which is not "
                                 f"among {', '.join(chosen)}")
        if file:
            options[name] = replace(options[name], **{key: file})
    check_flight(task=task, seed=seed, conditions=conditions, bag=bag, compression=compression,
                 json_path=json_path, files=(nmpc_file, policy, faults))
    from beetle_omni_ros.evaluation.command import run_evaluate
    from beetle_omni_ros.runs.metrics import failed
    results = run_evaluate(controllers=chosen, task=task, conditions=conditions, robot=robot,
                           plant=plant, seed=seed, bag=bag, compression=compression,
                           json_path=json_path, faults=faults, options=options)
    if any(map(failed, results.values())):
        raise typer.Exit(FAILED)


def compare(controllers: Annotated[Optional[str], typer.Option(
                '--controllers', metavar='NAME,...',
                help=f'Controllers: {KNOWN}. Default: the shipped policies that exist, and '
                     'both NMPCs.')] = None,
            tasks: Annotated[Optional[str], typer.Option(
                '--tasks', metavar='TASK,...', help='Names or pose files. Default: all.')] = None,
            conditions: Annotated[str, typer.Option(
                '--conditions', metavar='NAME,...',
                help='nominal, published, or both.')] = ','.join(CONDITIONS),
            seeds: Annotated[Optional[str], typer.Option(
                '--seeds', metavar='N,...',
                help='Default: 0,1; only 0 for tasks of more than 50 s.')] = None,
            policy: PolicyOption = None,
            plant: PlantOption = None,
            jobs: JobsOption = None,
            backend: Annotated[str, typer.Option(
                '--backend', metavar='processes|ray', help='Run the flights on this computer, or '
                                                           'on Ray.')]
            = 'processes',
            address: Annotated[Optional[str], typer.Option(
                '--ray-address', metavar='ADDRESS', envvar='RAY_ADDRESS',
                help='Address of a running cluster. Default: Ray on this computer.')] = None,
            output: Annotated[Path, typer.Option(
                '--output', '-o', metavar='DIR', help='Folder for page, pictures and JSON.')]
            = Path('comparison'),
            cache: Annotated[Optional[Path], typer.Option(
                '--cache', metavar='DIR', help='Cache of finished flights. Default: .flights in '
                                               'the output.')] = None,
            fresh: Annotated[bool, typer.Option(
                '--fresh', help='Ignore the cache.')] = False,
            json_path: JsonOption = None):
    """
    Fly every experiment with several controllers and write one page about it.

    An interrupted or repeated comparison flies only the missing flights. Example: beetle_omni
    compare --controllers rl,nmpc --tasks waypoints --seeds 0,1,2
    """
    arguments = {'controllers': names('--controllers', controllers),
                 'tasks': names('--tasks', tasks),
                 'conditions': names('--conditions', conditions),
                 'seeds': numbers('--seeds', seeds)}
    check_files(policy)
    check_writable(json_path)
    from beetle_omni_ros.comparison.command import run_compare
    run_compare(**arguments, output=output, jobs=jobs, backend=backend, address=address,
                cache=cache, fresh=fresh, policy=policy, plant=plant, json_path=json_path)


def faults(faults: Annotated[Optional[Path], typer.Option(
               '--faults', metavar='FILE', help='List of faults. Default: the shipped '
                                                'params/faults.yaml.')] = None,
           only: Annotated[Optional[str], typer.Option(
               '--only', metavar='NAME,...', help='Faults of the list. Default: all.')] = None,
           starts: Annotated[Optional[str], typer.Option(
               '--from', metavar='NAME,...', help='Flight before the fault: hover, moving, '
                                                  'upside_down, or random (a random time of '
                                                  'random100). Default: the first three.')] = None,
           seeds: Annotated[int, typer.Option(
               '--seeds', metavar='N', min=1, help='Flights of each fault from each start.')] = 1,
           seed: Annotated[int, typer.Option(
               '--seed', metavar='N', min=0, max=2**31 - 1,
               help='Seed of the first flight; it grows by one with each further flight.')] = 0,
           conditions: ConditionsOption = 'nominal',
           controller: ControllerOption = DEFAULT,
           plant: PlantOption = None,
           landings: Annotated[int, typer.Option(
               '--landings', metavar='N', min=0, help='Fly N landings from random attitudes '
                                                      'instead of the list.')] = 0,
           without_mocap: Annotated[bool, typer.Option(
               '--without-mocap', help='With --landings: motion capture is lost at the '
                                       'beginning.')] = False,
           healthy: Annotated[float, typer.Option(
               '--healthy', metavar='HOURS', min=0.0, max=1000.0,
               help='Fly for this time without a fault under each of nominal, published and '
                    'effects, and count false alarms, instead of the list.')] = 0.0,
           jobs: JobsOption = None,
           bags: Annotated[bool, typer.Option(
               '--bags', help='Record each flight in --output, and read its bag.')] = False,
           output: Annotated[Optional[Path], typer.Option(
               '--output', '-o', metavar='DIR', help='Folder for page, Markdown and JSON.')]
           = None,
           docs: Annotated[Optional[Path], typer.Option(
               '--docs', metavar='FILE', help='Markdown file in which the fault table is '
                                              'replaced.')]
           = None,
           json_path: JsonOption = None):
    """
    Inject a list of faults into flights, on all cores, and compare outcomes with expectations.

    Each fault occurs in hover, on the move and upside down; each flight ends with a landing.
    Example: beetle_omni faults --only rotor_1_stops,mocap_lost --seeds 3 --output runs_out/faults
    """
    if conditions not in CONDITIONS:
        raise ParameterError(f"--conditions '{conditions}': expected {' or '.join(CONDITIONS)}")
    check_files(faults)
    if without_mocap and not landings:
        raise ParameterError('--without-mocap: expected --landings N with it')
    from beetle_omni_ros.faults.command import run_faults
    run_faults(faults=faults, only=names('--only', only), starts=names('--from', starts),
               seeds=seeds, seed=seed, conditions=conditions, controller=controller, jobs=jobs,
               output=output, json_path=json_path, docs=docs, bags=bags, landings=landings,
               without_mocap=without_mocap, healthy=healthy, plant=plant)


def report(runs: Annotated[list[Path], typer.Argument(
               metavar='RUN...', help='Recorded bags: rosbag2 folders, or one of their files.')],
           output: Annotated[Path, typer.Option(
               '--output', '-o', metavar='FILE', help='The page to write.')]
           = Path('report.html'),
           json_path: JsonOption = None):
    """
    Write one self-contained HTML page with metrics and plots of one or several runs.

    Example: beetle_omni report flight_a flight_b --output report.html
    """
    check_writable(output, 'report')
    check_writable(json_path)
    from beetle_omni_ros.view.report import run_report
    run_report(runs, output, json_path=json_path)


def controllers(json_path: JsonOption = None):
    """
    List the registered controllers.

    Others fly as FILE.py:Class or package.module:Class, see docs/how-to/own_controller.md.
    Example: beetle_omni controllers --json controllers.json
    """
    from rich.table import Table

    from beetle_omni_ros.runs.table import Terminal
    check_writable(json_path)
    found = {name: _known(name) for name in registry.names()}
    table = Table(box=None, header_style='dim', padding=(0, 2, 0, 0))
    for column in ('name', 'description', 'rate [Hz]', 'parameters', 'policy', 'actuators lost',
                   'guidance'):
        table.add_column(column)
    for name, known in found.items():
        if 'error' in known:
            table.add_row(name, known['error'])
            continue
        table.add_row(name, known['description'], f"{known['rate_hz']:g}",
                      known['parameters_file'] or '–', known['policy_file'] or '–',
                      'flies' if known['flies_degraded'] else '–', known['guidance'])
    Terminal().print(table)
    write_json(json_path, found)


def _known(name):
    """Properties of a controller, or the error of its import."""
    try:
        entry = registry.find(name)
    except ParameterError as error:
        return {'error': str(error)}
    return {'description': entry.description, 'rate_hz': 1 / entry.period,
            **{key: getattr(entry, key) for key in (
                'parameters_file', 'policy_file', 'flies_degraded', 'guidance', 'stands_by')}}
