"""Subcommands for flights, their recordings, models from data, and the list of controllers."""

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
    PublishedOption,
    RobotOption,
    SeedOption,
    TaskOption,
)
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions, DEFAULT, owner
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.files import check_writable, write_json

PageOption = Annotated[Optional[Path], typer.Option(
    '--report', metavar='FILE', help='Write a self-contained HTML page with plots.')]
ParamsOption = Annotated[Optional[Path], typer.Option(
    '--params', metavar='FILE', help='Write a robot file with the result.')]
RateOption = Annotated[Optional[float], typer.Option(
    '--rate', min=1, metavar='HZ', help='Rows a second of time series without a column of times.')]
HOLDOUT = '--holdout'


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
        json_path: JsonOption = None):
    """
    Fly the whole ROS graph in real time against the simulated robot.

    Takes off, flies the task, lands, records a bag and prints the result table.
    Example: beetle_omni fly --controller nmpc --task waypoints --bag my_flight
    """
    given, bag = bag, bag or Path('runs_out') / f'fly_{datetime.now():%Y%m%d_%H%M%S}'
    check_flight(conditions, compression, json_path, nmpc_file, policy, faults)
    from beetle_omni_ros.nodes.fly import run_fly
    if not given:
        typer.echo(f'bag: {bag}')
    code = run_fly(controller=controller, task=task, bag=bag, compression=compression,
                   seed=seed, conditions=conditions, actuators=actuators, clock=clock,
                   robot=robot, plant=plant, nmpc=nmpc_file, policy=policy,
                   allow_other_robot=allow_other_robot, standby=standby,
                   composed=composed, faults=faults, json_path=json_path,
                   domain_id=domain_id, discovery=discovery,
                   view=view)
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
    check_flight(conditions, compression, json_path, nmpc_file, policy, faults)
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
                cache=cache, policy=policy, plant=plant, json_path=json_path)


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
           json_path: JsonOption = None):
    """
    Inject a list of faults into flights, on all cores, and compare outcomes with expectations.

    Each fault occurs in hover, on the move and upside down; each flight ends with a landing.
    Example: beetle_omni faults --only rotor_1_stops,mocap_lost --seeds 3 --output runs_out/faults
    """
    check_flight(conditions, 'none', json_path, faults)
    if without_mocap and not landings:
        raise ParameterError('--without-mocap: expected --landings N with it')
    from beetle_omni_ros.faults.command import run_faults
    run_faults(faults=faults, only=names('--only', only), starts=names('--from', starts),
               seeds=seeds, seed=seed, conditions=conditions, controller=controller, jobs=jobs,
               output=output, json_path=json_path, bags=bags, landings=landings,
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


def gap(runs: Annotated[list[Path], typer.Argument(
            metavar='RUN...', help='Recorded flights (bags), or logs of the joints (CSV, or bags '
                                     'with only joint_states and command).')],
        holdout: Annotated[Optional[list[Path]], typer.Option(
            HOLDOUT, metavar='RUN...', help='Flights for validation only. Default: the last run '
                                            'of three or more.')] = None,
        robot: Annotated[Optional[Path], typer.Option(
            '--robot', metavar='FILE', help='Robot file with which the flights are compared. '
                                            'Default: the shipped params/robot.yaml.')] = None,
        apply: Annotated[Optional[Path], typer.Option(
            '--apply', metavar='FILE', help='Write a robot file with the named effects.')] = None,
        page: PageOption = None,
        parameters: Annotated[Optional[Path], typer.Option(
            '--gap', metavar='FILE', help='File with changes to params/gap.yaml.')] = None,
        fix: Annotated[bool, typer.Option(
            '--fix', help='Correct damaged recordings if the correction is certain; the bags stay '
                          'unchanged.')] = False,
        tolerances: Annotated[bool, typer.Option(
            '--tolerances', help="With --apply: also write this robot's own mass, inertia, gains, "
                                 'lags and rotor positions, as fitted within tolerance.')] = False,
        json_path: JsonOption = None):
    """
    Compare flights with the robot model, identify the missing effect and add it to the model.

    Example: beetle_omni gap flight1 flight2 --holdout flight3 --apply robot_new.yaml
    """
    from beetle_omni_ros.identify.gap.command import run_gap
    raise typer.Exit(run_gap(runs, holdout or [], robot, apply, json_path, page,
                             parameters=parameters, fix=fix, tolerances=tolerances))


def spread(arguments: list[str]) -> list[str]:
    """
    Interpret `gap RUN... --holdout RUN RUN` as two held-out flights.

    If no run precedes `--holdout`, only the first run after it is held out.
    """
    spread, runs, holding = [], 0, False
    for k, argument in enumerate(arguments):
        if argument == HOLDOUT:
            holding = True
        elif argument.startswith('-'):
            holding = False
        elif arguments[k - 1].startswith('-') and k and arguments[k - 1] != HOLDOUT:
            pass            # the value of another option
        elif holding and arguments[k - 1] != HOLDOUT and runs:
            spread.append(HOLDOUT)
        elif not holding:
            runs += 1
        spread.append(argument)
    return spread


def joint(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG...', help='Response logs (CSV) or recorded run (bag), see '
                                  'docs/how-to/identification.md.')],
          validate: Annotated[Optional[list[Path]], typer.Option(
              '--validate', metavar='LOG.csv...', help='Further logs for validation.')] = None,
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Fit one servo model to the first 60 % of response logs; the rest is for validation.

    Several logs of the same servos are fitted together. With --validate, one log is fitted.

    Example: beetle_omni identify joint slow.csv --validate fast.csv --report servos.html
    """
    from beetle_omni_ros.runs.bag import runs_in
    logs = runs_in(logs)
    more = logs[1:] if validate else []     # `--validate a.csv b.csv` puts b.csv here
    from beetle_omni_ros.identify.command import run_identify_joint
    run_identify_joint(logs[:len(logs) - len(more)], validate=[*(validate or []), *more],
                       robot=robot, report=report, params=params, json_path=json_path)


def rotor(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG.csv...', help='Logs of a force-torque stand, see '
                                         'docs/how-to/identification.md.')],
          columns: Annotated[Optional[list[str]], typer.Option(
              '--column', metavar='QUANTITY=[-]COLUMN[*FACTOR]',
              help='Column of a quantity with sign and factor to SI units, e.g. thrust=-fz or '
                   'thrust=load_g*0.00981; may be repeated.')] = None,
          rate: RateOption = None,
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Fit thrust, torque and lag of a rotor to logs of a force-torque stand.

    Ends with status 3 for the verdict bad_data.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    from beetle_omni_ros.identify.command import run_identify_rotor
    results = run_identify_rotor(logs, columns=columns or (), rate=rate, robot=robot,
                                 report=report, params=params, json_path=json_path)
    raise typer.Exit(3 if results['verdict'] == 'bad_data' else 0)


def robot(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG...', help='Response logs of the joints (CSV or bag) and logs of a '
                                     'force-torque stand, recognised by their header.')],
          params: Annotated[Path, typer.Option(
              '--params', metavar='FILE', help='The robot file to write.')],
          rate: RateOption = None, robot: PublishedOption = None,
          picture: Annotated[Optional[Path], typer.Option(
              '--picture', metavar='FILE', help='Draw the logs with both robots (.png or .svg).')]
          = None, json_path: JsonOption = None):
    """
    Write a robot file with intervals and origins from all logs of servos and rotors.

    Example: beetle_omni identify robot slow.csv fast.csv bench.csv --params my_robot.yaml
    """
    from beetle_omni_ros.identify.command import run_identify_robot
    run_identify_robot(logs, params, rate=rate, robot=robot, picture=picture,
                       json_path=json_path)


def train(output: Annotated[Path, typer.Option(
              '--output', metavar='DIR', help='Folder for checkpoints, TensorBoard log and '
                                              'policy.onnx. Default: that of --resume.')] = None,
          config: Annotated[Optional[Path], typer.Option(
              '--config', metavar='FILE', help='Training parameters. Default: the shipped '
                                               'params/train.yaml.')] = None,
          changes: Annotated[Optional[list[str]], typer.Option(
              '--set', metavar='KEY=VALUE', help='Replace a parameter, e.g. iterations=5000 or '
                                                 'ppo.robots=8192; may be repeated.')] = None,
          seed: Annotated[Optional[int], typer.Option(
              '--seed', min=0, max=2**31 - 1, help='Seed of all random numbers.')] = None,
          memory: Annotated[Optional[bool], typer.Option(
              '--memory', help='Add the estimated disturbance to the inputs of the '
                               'policy.')] = None,
          device: Annotated[str, typer.Option('--device', help='auto, cpu, cuda[:N].')] = 'auto',
          resume: Annotated[Optional[Path], typer.Option(
              '--resume', metavar='DIR', help='Continue from the last checkpoint of a run, or '
                                              'from a model_N.pt.')] = None,
          smoke: Annotated[bool, typer.Option(
              '--smoke', help='Test all parts with tiny sizes.')] = False,
          stop_after: Annotated[Optional[float], typer.Option(
              '--stop-after', min=0, metavar='SECONDS',
              help='End the training after this time.')] = None,
          robot: Annotated[Optional[Path], typer.Option(
              '--robot', metavar='FILE', help='Robot file for the training, with its effects. '
                                              'Default: the shipped params/robot.yaml.')] = None,
          json_path: JsonOption = None):
    """
    Train a policy and export it to ONNX; needs the extra 'train' and a GPU.

    Several GPUs: torchrun --nproc-per-node N -m beetle_omni_ros.cli train --output DIR
    """
    from beetle_omni_ros.train.command import parse_changes, run_train
    run_train(output=output, config=config, robot=robot, device=device, resume=resume,
              changes=parse_changes(changes or [], seed=seed, memory=memory),
              smoke=smoke, stop_after=stop_after, json_path=json_path)
