"""Subcommands. Each passes its options, under their names, to the function that does the work."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated

from typer import Argument, echo, Option

from beetle_omni_ros import options
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions, DEFAULT, OWNER
from beetle_omni_ros.identify_commands import gap, identify, improve
from beetle_omni_ros.model.schema import ParameterError

app = options.Commands(
    help='Fly, evaluate and report on the tiltable quadrotor; --version: its version.')


@app.command()
def fly(controller: options.ControllerOption = DEFAULT,
        task: options.TaskOption = 'waypoints',
        bag: Annotated[Path | None, Option(metavar='DIR', help=(
            'New folder for the recorded bag. Default: runs_out/fly_DATE.'))] = None,
        conditions: options.ConditionsOption = 'nominal',
        seed: options.SeedOption = 0,
        actuators: Annotated[str | None, Option(
            callback=options.one_of, metavar='emulated|direct', help=(
            'emulated (default): commands go through joint_bridge_node, rotor_bridge_node, serial '
            'ports and emulated devices; direct: they go straight to the simulated '
            'plant.'))] = None,
        clock: Annotated[str, Option(
            callback=options.one_of, metavar='auto|system|simulated', help=(
            'system: real time; simulated: simulated time on /clock, which waits for late nodes, '
            'with direct actuators; auto: real time, and again in simulated time if this computer '
            'was too slow.'))] = 'auto',
        robot: options.RobotOption = None,
        plant: options.PlantOption = None,
        nmpc: options.NmpcOption = None,
        policy: options.PolicyOption = None,
        standby: Annotated[bool, Option('--standby/--alone', help=(
            'Run the other controllers on standby, to be selected in flight, or only the active '
            'controller.'))] = True,
        faults: options.FaultsOption = None,
        components: options.ComponentOption = None,
        domain_id: options.DomainOption = None,
        view: Annotated[bool, Option('--view', help=(
            'Show the flight in the browser, as beetle_omni view does, and write a page that '
            'plays it into the folder of the bag.'))] = False,
        full: options.FullOption = False,
        json_path: options.JsonOption = None):
    """
    Fly the simulated robot with the whole ROS graph in real time.

    Takes off, flies the task, lands, records a bag and prints the result table.
    Example: beetle_omni fly --controller nmpc --task waypoints --bag my_flight
    """
    given = dict(locals())
    from beetle_omni_ros.ros.fly import run_fly
    if bag is None:
        bag = Path('runs_out') / f'fly_{datetime.now():%Y%m%d_%H%M%S}'
        echo(f'bag: {bag}')
    return run_fly(**{**given, 'bag': bag, 'components': components or ()})


@app.command()
def evaluate(controllers: Annotated[str, Option(
                 '--controllers', '--controller', callback=options.several,
                 metavar='NAME,...', help=(
                     f'Controllers to fly one after the other: {options.KNOWN}.'))] = DEFAULT,
             task: options.TaskOption = 'random100',
             conditions: options.ConditionsOption = 'nominal',
             seed: options.SeedOption = 0,
             robot: options.RobotOption = None,
             plant: options.PlantOption = None,
             nmpc: options.NmpcOption = None,
             policy: options.PolicyOption = None,
             without: Annotated[str, Option(metavar='LAYER,...', help=(
                 'Layers of the guidance that are off: unwinding, routing, easing, trimming, '
                 'gravity, or all.'))] = '',
             bag: Annotated[Path | None, Option(metavar='DIR', help=(
                 'New folder for the bag; with several controllers it contains one bag for '
                 'each.'))] = None,
             faults: options.FaultsOption = None,
             actuators: Annotated[str, Option(
                 callback=options.one_of, metavar='direct|emulated', help=(
                     'direct: commands go straight to the simulated plant; emulated: through '
                     'drivers, serial ports and emulated devices, in real time.'))] = 'direct',
             components: options.ComponentOption = None,
             full: options.FullOption = False,
             json_path: options.JsonOption = None):
    """
    Fly a task in one process, deterministic and without a clock.

    Plant, sensors, estimator, controllers and actuators are those of the ROS graph.
    Example: beetle_omni evaluate --controllers nmpc --task random100 --json result.json
    """
    if without and not any(hasattr(registry.find(name).parameter_class, 'without')
                           for name in controllers):
        raise ParameterError(f'--without {without}: no controller with guidance among '
                             f"{', '.join(controllers)}")
    given = {name: ControllerOptions(without=without) for name in controllers}
    for option, file, key in (('--nmpc', nmpc, 'parameters'), ('--policy', policy, 'policy')):
        name = OWNER[key]
        if file and name not in controllers:
            raise ParameterError(f"{option} {file}: for the controller '{name}', which is not "
                                 f"among {', '.join(controllers)}")
        if file:
            given[name] = replace(given[name], **{key: file})
    from beetle_omni_ros.bags.metrics import failed
    from beetle_omni_ros.flight.evaluate import run_evaluate
    results = run_evaluate(controllers=controllers, task=task, conditions=conditions, robot=robot,
                           plant=plant, seed=seed, bag=bag, json_path=json_path,
                           faults=faults, actuators=actuators, components=components or (),
                           options=given, full=full)
    if bag is None:
        echo('next:  the same with --bag DIR records the flight; with --full it prints everything')
    return options.FAILED if any(map(failed, results.values())) else 0


@app.command()
def compare(controllers: Annotated[str | None, Option(
                '--controllers', '--controller', callback=options.several,
                metavar='NAME,...', help=(
                    f"Controllers: {options.KNOWN}. Default: {', '.join(registry.COMPARED)}; a "
                    'missing policy is left out.'))] = None,
            tasks: Annotated[str | None, Option(
                callback=options.several, metavar='TASK,...', help=(
                'Names or pose files. Default: those of the publication.'))] = None,
            conditions: Annotated[str, Option(callback=options.several, metavar='NAME,...', help=(
                'nominal, published, or both.'))] = ','.join(options.CONDITIONS),
            seeds: Annotated[str | None, Option(callback=options.whole, metavar='N,...', help=(
                'Default: 0 to 9; 0 to 5 above 50 s, 0 to 2 above 300 s.'))] = None,
            policy: options.PolicyOption = None,
            plant: options.PlantOption = None,
            jobs: options.JobsOption = None,
            output: options.OutputOption = Path('comparison'),
            cache: Annotated[Path | None, Option(metavar='DIR', help=(
                'Cache of finished flights. Default: .flights in the output.'))] = None,
            json_path: options.JsonOption = None):
    """
    Fly every experiment with several controllers; write one page.

    An interrupted or repeated comparison flies only the missing flights. Example: beetle_omni
    compare --controllers rl,nmpc --tasks waypoints --seeds 0,1,2
    """
    given = dict(locals())
    from beetle_omni_ros.flight.compare import run_compare
    run_compare(**given)


@app.command()
def faults(faults: Annotated[Path | None, Option(metavar='FILE', help=(
               'List of faults. Default: the shipped params/faults.yaml.'))] = None,
           only: Annotated[str | None, Option(callback=options.several, metavar='NAME,...', help=(
               'Faults of the list. Default: all.'))] = None,
           starts: Annotated[str | None, Option(
               '--from', callback=options.several, metavar='NAME,...', help=(
                   'Flight before the fault: hover, moving, upside_down, or random (a random time '
                   'of random100). Default: the first three.'))] = None,
           seeds: Annotated[int, Option(metavar='N', min=1, help=(
               'Flights of each fault from each start.'))] = 1,
           seed: Annotated[int, Option(metavar='N', min=0, max=2**31 - 1, help=(
               'Seed of the first flight; it grows by one with each further flight.'))] = 0,
           conditions: options.ConditionsOption = 'nominal',
           controller: options.ControllerOption = DEFAULT,
           plant: options.PlantOption = None,
           landings: Annotated[int, Option(metavar='N', min=0, help=(
               'Fly N landings from random attitudes instead of the list.'))] = 0,
           without_mocap: Annotated[bool, Option('--without-mocap', help=(
               'With --landings: motion capture is lost at the beginning.'))] = False,
           healthy: Annotated[float, Option(metavar='HOURS', min=0.0, max=1000.0, help=(
               'Fly for this time without a fault under each of nominal, published and effects, '
               'and count false alarms, instead of the list.'))] = 0.0,
           jobs: options.JobsOption = None,
           bags: Annotated[bool, Option('--bags', help=(
               'Record each flight in --output.'))] = False,
           output: options.OutputOption = None,
           json_path: options.JsonOption = None):
    """
    Inject a list of faults into flights, on all cores.

    Each fault occurs in hover, on the move and upside down; each flight ends with a landing.
    Outcomes are compared with the expected ones.
    Example: beetle_omni faults --only rotor_1_stops,mocap_lost --seeds 3 --output runs_out/faults
    """
    given = dict(locals())
    if without_mocap and not landings:
        raise ParameterError('--without-mocap: expected --landings N with it')
    from beetle_omni_ros.flight.faults import run_faults
    run_faults(**given)


@app.command()
def report(paths: Annotated[list[Path], Argument(metavar='RUN...', help=(
               'Recorded bags: rosbag2 folders, or one of their files.'))],
           output: Annotated[Path, Option(
               '--output', '-o', callback=options.writable, metavar='FILE',
               help='The page to write.')]
           = Path('report.html'),
           full: options.FullOption = False,
           json_path: options.JsonOption = None):
    """
    Write one HTML page with metrics and plots of one or more runs.

    Example: beetle_omni report flight_a flight_b --output report.html
    """
    given = dict(locals())
    from beetle_omni_ros.show.report import run_report
    run_report(**given)


@app.command()
def view(runs: Annotated[list[Path] | None, Argument(metavar='RUN...', help=(
             'Recorded bags, shown together; without RUN: a running graph.'))] = None,
         namespace: options.NamespaceOption = '',
         domain_id: options.DomainOption = None,
         host: Annotated[str, Option(metavar='ADDRESS', help=(
             'Address at which the page is served; 0.0.0.0: to the whole network.'))]
         = '127.0.0.1',
         port: Annotated[int, Option(
             metavar='N', min=1, max=65535, help='Port of the page.')] = 8080,
         rerun: Annotated[bool, Option('--rerun', help=(
             'Open the runs in Rerun instead; needs the extra rerun.'))] = False):
    """
    Show a running graph or recorded runs in 3D in the browser.

    Prints the address of the page, which needs no network, and runs until Ctrl-C. Example:
    beetle_omni view my_run/rl my_run/nmpc
    """
    if rerun and not runs:
        raise ParameterError('--rerun: expected RUN with it, a recording')
    page = {'host': host, 'port': port}
    graph = {'namespace': namespace, 'domain_id': domain_id}
    if not runs:
        from beetle_omni_ros.ros.clients import run_live
        run_live(**graph, **page)
        return
    for name, value in graph.items():
        if value not in ('', None):
            raise ParameterError(f"--{name.replace('_', '-')}: expected without RUN, which is a "
                                 'recording')
    if rerun:
        from beetle_omni_ros.show.rerun_view import run_rerun
        run_rerun(runs)
        return
    from beetle_omni_ros.show.recorded import run_view
    run_view(runs, **page)


for command in (gap, improve):
    app.command()(command)


@app.command()
def train(output: Annotated[Path | None, Option(metavar='DIR', help=(
              'Folder for checkpoints, TensorBoard log and policy.onnx. Default: that of '
              '--resume.'))] = None,
          config: Annotated[Path | None, Option(metavar='FILE', help=(
              'Training parameters. Default: the shipped params/train.yaml.'))] = None,
          changes: Annotated[list[str], Option('--set', metavar='KEY=VALUE', help=(
              'Replace a parameter, e.g. iterations=5000 or ppo.robots=8192; may be '
              'repeated.'))] = (),
          seed: Annotated[int | None, Option(metavar='N', min=0, max=2**31 - 1, help=(
              'Seed of all random numbers.'))] = None,
          device: Annotated[str, Option(metavar='NAME', help='auto, cpu, cuda[:N].')] = 'auto',
          resume: Annotated[Path | None, Option(metavar='DIR', help=(
              'Continue from the last checkpoint of a run, or from a model_N.pt.'))] = None,
          teacher: Annotated[Path | None, Option(metavar='FILE', help=(
              'Begin as the policy of a model_N.pt or of an ONNX file does, with a network of any '
              'size.'))] = None,
          smoke: Annotated[bool, Option('--smoke', help=(
              'Test all parts with tiny sizes.'))] = False,
          stop_after: Annotated[float | None, Option(min=0, metavar='SECONDS', help=(
              'End the training after this time.'))] = None,
          robot: options.TheRobotOption = None,
          json_path: options.JsonOption = None):
    """
    Train a policy and export it to ONNX.

    Needs the extra 'train' and a GPU.
    """
    from beetle_omni_ros.train.runner import parse_changes, run_train
    run_train(output=output, config=config, robot=robot, device=device, resume=resume,
              teacher=teacher, changes=parse_changes(changes, seed=seed),
              smoke=smoke, stop_after=stop_after, json_path=json_path)


@app.command()
def check(servo_port: Annotated[str | None, Option(metavar='PORT', help=(
              'Serial port of the servos. Default: the port in --servo-bus.'))] = None,
          board_port: Annotated[str | None, Option(metavar='PORT', help=(
              'Serial port of the motor board. Default: the port in --motor-board.'))] = None,
          servo_bus: Annotated[Path | None, Option(metavar='FILE', help=(
              'Settings of the servo bus. Default: the shipped params/servo_bus.yaml.'))] = None,
          motor_board: Annotated[Path | None, Option(metavar='FILE', help=(
              'Settings of the motor board. Default: the shipped '
              'params/motor_board.yaml.'))] = None,
          robot: options.TheRobotOption = None,
          seconds: Annotated[float, Option(metavar='S', min=1, max=600, help=(
              'Time to receive from the motor board, and from ROS.'))] = 3.0,
          skip: Annotated[list[str], Option(metavar='servos|board|ros', help=(
              'Skip a part; may be repeated.'))] = (),
          namespace: options.NamespaceOption = '',
          json_path: options.JsonOption = None):
    """
    Check ports, devices and clocks of the real robot before flight.

    It moves nothing and changes no setting. Exit status 0: nothing failed; 1: something failed.
    Example: beetle_omni check --servo-port /dev/ttyUSB0 --skip board
    """
    def listen(duration):
        from beetle_omni_ros.ros.clients import listen as listen_to_ros
        return listen_to_ros(duration, namespace)

    from beetle_omni_ros.drivers.check import run_check
    from beetle_omni_ros.show import page
    status = run_check(listen=listen, servo_port=servo_port, board_port=board_port,
                       servo_bus=servo_bus, motor_board=motor_board, robot=robot, seconds=seconds,
                       skip=tuple(skip), json_path=json_path)
    page.print_end(page.Terminal(), [json_path],
                   'what the table says, then the same again' if status
                   else ('check',) if skip
                   else 'the first flight with hardware, docs/tutorials/hardware_flight.md')
    return status


@app.command()
def drive(source: Annotated[str, Argument(
              callback=options.one_of, metavar='keyboard|joystick|terminal', help=(
              'Input: keys of this terminal, the topic joy, or typed commands.'))] = 'keyboard',
          parameters: Annotated[Path | None, Option('--params', metavar='FILE', help=(
              'Limits, axes, buttons and named poses. Default: the shipped '
              'params/drive.yaml.'))] = None,
          robot: options.RobotOption = None,
          domain_id: options.DomainOption = None):
    """
    Drive a running graph by hand, within all supervisor checks.

    The target moves at limited speed. Example: beetle_omni drive keyboard
    """
    given = dict(locals())
    from beetle_omni_ros.ros.driver import run_drive
    run_drive(**given)


app.add_typer(identify, name='identify')
