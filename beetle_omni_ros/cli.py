"""
The `beetle_omni` command.

Every subcommand imports what it needs when it runs, so that `--help` is quick and an
analysis needs no ROS. Unusable input ends with status 2 and one line on standard error.
"""

from __future__ import annotations

from pathlib import Path
import sys
from typing import Annotated, Optional

import typer
from typer.main import get_command

from beetle_omni_ros import __version__
from beetle_omni_ros.robot.schema import ParameterError

UNUSABLE, FAILED, INTERRUPTED = 2, 1, 130
CONDITIONS = ('nominal', 'published')
# Modules that come with ROS, or with the package's extra 'ros'; those of the extra 'train'.
ROS_MODULES, ROS_ENDINGS = ('rclpy', 'ament_index_python'), ('_msgs', '_srvs', '_interfaces')
TRAIN_MODULES = ('onnx', 'onnxscript', 'rsl_rl', 'tensorboard', 'tensordict', 'torch')

app = typer.Typer(no_args_is_help=True, add_completion=False,
                  context_settings={'help_option_names': ['-h', '--help']},
                  help='Fly, evaluate and report on the tiltable quadrotor.')

TaskOption = Annotated[str, typer.Option(
    '--task', help='CSV file of poses, or waypoints, randomN (random100), lemniscate, hover, '
                   'force, torque or payload.', metavar='TASK')]
ConditionsOption = Annotated[str, typer.Option(
    '--conditions', metavar='nominal|published',
    help="The simulator as measured, or with the publication's randomisation drawn from --seed.")]
SeedOption = Annotated[int, typer.Option(
    '--seed', min=0, max=2**31 - 1, help='Of random poses and of everything random in the '
                                         'simulation.')]
RobotOption = Annotated[Optional[Path], typer.Option(
    '--robot', metavar='FILE', help='What estimator and controller believe. '
                                    'Default: the shipped params/robot.yaml.')]
PlantOption = Annotated[Optional[Path], typer.Option(
    '--plant', metavar='FILE', help='What is true in the simulation. Default: as --robot.')]
PolicyOption = Annotated[Optional[Path], typer.Option(
    '--policy', metavar='FILE', help="Another policy (ONNX) for the controller 'rl'.")]
OtherRobotOption = Annotated[bool, typer.Option(
    '--allow-other-robot', help='Fly a policy although it was trained for other robot '
                                'parameters.')]
JsonOption = Annotated[Optional[Path], typer.Option(
    '--json', metavar='FILE', help='Write the results there as JSON.')]


def _version(wanted: bool):
    if wanted:
        typer.echo(f'beetle_omni {__version__}')
        raise typer.Exit()


@app.callback()
def _common(version: Annotated[bool, typer.Option(
        '--version', callback=_version, is_eager=True, help='Show the version.')] = False):
    pass


@app.command()
def fly(bag: Annotated[Path, typer.Option(
            '--bag', metavar='DIR', help='New folder for the recorded bag.')],
        controller: Annotated[str, typer.Option(
            '--controller', metavar='nmpc|rl', help='The active controller.')] = 'nmpc',
        task: TaskOption = 'waypoints',
        conditions: ConditionsOption = 'nominal',
        seed: SeedOption = 0,
        robot: RobotOption = None,
        plant: PlantOption = None,
        policy: PolicyOption = None,
        allow_other_robot: OtherRobotOption = False,
        standby: Annotated[bool, typer.Option(
            '--standby/--alone', help='The other controller runs too, to be selected in flight; '
                                      'or only the active one.')] = True,
        composed: Annotated[bool, typer.Option(
            '--composed/--separate', help='All nodes in one process, or one process each.')]
        = True,
        domain_id: Annotated[Optional[int], typer.Option(
            '--domain-id', min=0, max=101, help='ROS domain. Default: a free one.')] = None,
        json_path: JsonOption = None):
    """
    Fly the whole ROS graph in real time against the simulated robot.

    Takes off, flies the task, lands, records a bag and prints the result table.
    Example: beetle_omni fly --controller nmpc --task waypoints --bag my_flight
    """
    _check(task=task, seed=seed, conditions=conditions, bag=bag, json_path=json_path,
           files=(robot, plant, policy))
    from beetle_omni_ros.nodes.fly import FlightError, run_fly
    try:
        code = run_fly(controller=controller, task=task, bag=bag, seed=seed,
                       conditions=conditions, robot=robot, plant=plant, policy=policy,
                       allow_other_robot=allow_other_robot, standby=standby, composed=composed,
                       json_path=json_path, domain_id=domain_id)
    except FlightError as error:
        raise typer.Exit(_fail(error, FAILED)) from None
    raise typer.Exit(code if isinstance(code, int) else 0)


@app.command()
def evaluate(controllers: Annotated[str, typer.Option(
                 '--controllers', metavar='NAME,...',
                 help='Controllers to fly one after the other: nmpc, rl, rl_memory, '
                      'nmpc_published, hover.')]
             = 'nmpc',
             task: TaskOption = 'random100',
             conditions: ConditionsOption = 'nominal',
             seed: SeedOption = 0,
             robot: RobotOption = None,
             plant: PlantOption = None,
             nmpc_file: Annotated[Optional[Path], typer.Option(
                 '--nmpc', metavar='FILE',
                 help="Other parameters for the controller 'nmpc'.")] = None,
             policy: PolicyOption = None,
             allow_other_robot: OtherRobotOption = False,
             bag: Annotated[Optional[Path], typer.Option(
                 '--bag', metavar='DIR', help='New folder for the bag; with several controllers '
                                              'it holds one bag for each.')] = None,
             json_path: JsonOption = None):
    """
    Fly a task in one process: deterministic and faster than real time.

    Plant, sensors, estimator, controllers and actuators are those of the ROS graph.
    Example: beetle_omni evaluate --controllers nmpc --task random100 --json result.json
    """
    names = [name.strip() for name in controllers.split(',') if name.strip()]
    if not names or len(set(names)) != len(names):
        raise ParameterError(f"--controllers '{controllers}': expected different names, "
                             'separated by commas')
    for option, file, name in (('--nmpc', nmpc_file, 'nmpc'), ('--policy', policy, 'rl')):
        if file and name not in names:
            raise ParameterError(f"{option} {file}: for the controller '{name}', which is not "
                                 f"among {', '.join(names)}")
    _check(task=task, seed=seed, conditions=conditions, bag=bag, json_path=json_path,
           files=(robot, plant, nmpc_file, policy))
    from beetle_omni_ros.evaluation.command import ControllerFiles, run_evaluate
    from beetle_omni_ros.evaluation.loop import FlightError
    try:
        run_evaluate(controllers=names, task=task, conditions=conditions, robot=robot,
                     plant=plant, seed=seed, bag=bag, json_path=json_path,
                     files=ControllerFiles(nmpc=nmpc_file, policy=policy,
                                           allow_other_robot=allow_other_robot))
    except FlightError as error:
        raise typer.Exit(_fail(error, FAILED)) from None


@app.command()
def compare(controllers: Annotated[Optional[str], typer.Option(
                '--controllers', metavar='NAME,...',
                help='Default: rl, rl_memory, nmpc and nmpc_published, as far as there.')] = None,
            tasks: Annotated[Optional[str], typer.Option(
                '--tasks', metavar='TASK,...', help='Names or pose files; default: all.')] = None,
            conditions: Annotated[str, typer.Option(
                '--conditions', metavar='NAME,...')] = ','.join(CONDITIONS),
            seeds: Annotated[Optional[str], typer.Option(
                '--seeds', metavar='N,...',
                help='Default: 0,1, and 0 for tasks of more than 300 s.')] = None,
            policy: PolicyOption = None,
            jobs: Annotated[Optional[int], typer.Option(
                '--jobs', '-j', min=1, help='Flights at a time. Default: one a core.')] = None,
            backend: Annotated[str, typer.Option(
                '--backend', metavar='processes|ray', help='This computer, or Ray.')]
            = 'processes',
            address: Annotated[Optional[str], typer.Option(
                '--ray-address', metavar='ADDRESS', envvar='RAY_ADDRESS',
                help='Of a running cluster. Default: Ray on this computer.')] = None,
            output: Annotated[Path, typer.Option(
                '--output', '-o', metavar='DIR', help='Folder for page, pictures and JSON.')]
            = Path('comparison'),
            cache: Annotated[Optional[Path], typer.Option(
                '--cache', metavar='DIR', help='Where finished flights are kept. '
                                               'Default: .flights in the output.')] = None,
            fresh: Annotated[bool, typer.Option(
                '--fresh', help='Fly again what is kept.')] = False,
            json_path: JsonOption = None):
    """
    Fly every experiment with several controllers and write one page about it.

    An interrupted or repeated comparison flies only what is missing.
    Example: beetle_omni compare --controllers rl,nmpc --tasks waypoints --seeds 0,1,2
    """
    from beetle_omni_ros.comparison.arguments import names, numbers
    from beetle_omni_ros.runs.json_file import check_writable
    arguments = {'controllers': names('--controllers', controllers),
                 'tasks': names('--tasks', tasks),
                 'conditions': names('--conditions', conditions),
                 'seeds': numbers('--seeds', seeds)}
    if policy and not policy.is_file():
        raise ParameterError(f'{policy}: no such file')
    if json_path:
        check_writable(json_path)
    from beetle_omni_ros.comparison.command import run_compare
    from beetle_omni_ros.comparison.sweep import SweepError
    try:
        run_compare(**arguments, output=output, jobs=jobs, backend=backend, address=address,
                    cache=cache, fresh=fresh, policy=policy, json_path=json_path)
    except SweepError as error:
        raise typer.Exit(_fail(error, FAILED)) from None


@app.command()
def report(runs: Annotated[list[Path], typer.Argument(
               metavar='RUN...', help='Recorded bags: rosbag2 folders, or one of their files.')],
           output: Annotated[Path, typer.Option(
               '--output', '-o', metavar='FILE', help='The page to write.')]
           = Path('report.html'),
           json_path: JsonOption = None):
    """
    Make one self-contained HTML page of metrics and plots, several runs side by side.

    Example: beetle_omni report flight_a flight_b --output report.html
    """
    from beetle_omni_ros.runs.json_file import check_writable
    check_writable(output, 'report')
    if json_path:
        check_writable(json_path)
    from beetle_omni_ros.runs.report import run_report
    run_report(runs, output, json_path=json_path)


identify_app = typer.Typer(no_args_is_help=True, context_settings={
    'help_option_names': ['-h', '--help']}, help='Fit the actuator models from measured data.')
app.add_typer(identify_app, name='identify')

PublishedOption = Annotated[Optional[Path], typer.Option(
    '--robot', metavar='FILE', help='The robot as believed so far. '
                                    'Default: the shipped params/robot.yaml.')]
PageOption = Annotated[Optional[Path], typer.Option(
    '--report', metavar='FILE', help='Write a self-contained HTML page with plots there.')]
ParamsOption = Annotated[Optional[Path], typer.Option(
    '--params', metavar='FILE', help='Write a robot file with the result there.')]


@identify_app.command()
def joint(logs: Annotated[list[Path], typer.Argument(
              metavar='LOG.csv', help='Response log, see docs/identification.md.')],
          validate: Annotated[Optional[list[Path]], typer.Option(
              '--validate', metavar='LOG.csv...', help='Further logs, which only judge.')] = None,
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Identify the tilt servos from the first 60 % of a response log; the rest judges.

    Example: beetle_omni identify joint slow.csv --validate fast.csv --report servos.html
    """
    log, *more = logs      # `--validate a.csv b.csv` leaves b.csv here
    if more and not validate:
        raise ParameterError(f'{more[0]}: one log is identified from; further ones follow '
                             '--validate')
    from beetle_omni_ros.identify.command import run_identify_joint
    run_identify_joint(log, validate=[*(validate or []), *more], robot=robot, report=report,
                       params=params, json_path=json_path)


@identify_app.command()
def rotor(log: Annotated[Path, typer.Argument(
              metavar='LOG.csv', help='Bench log, see docs/identification.md.')],
          robot: PublishedOption = None, report: PageOption = None, params: ParamsOption = None,
          json_path: JsonOption = None):
    """
    Identify thrust map and torque ratio of a rotor from a force-torque log.

    Example: beetle_omni identify rotor bench.csv --params my_robot.yaml --report rotor.html
    """
    from beetle_omni_ros.identify.command import run_identify_rotor
    run_identify_rotor(log, robot=robot, report=report, params=params, json_path=json_path)


@app.command()
def train(output: Annotated[Path, typer.Option(
              '--output', metavar='DIR', help='Folder for checkpoints, TensorBoard log and '
                                              'policy.onnx. Default: that of --resume.')] = None,
          config: Annotated[Optional[Path], typer.Option(
              '--config', metavar='FILE', help='Other parameters than params/train.yaml.')] = None,
          changes: Annotated[Optional[list[str]], typer.Option(
              '--set', metavar='KEY=VALUE', help='Replace a parameter, e.g. iterations=5000 or '
                                                 'ppo.robots=8192; may be repeated.')] = None,
          seed: Annotated[Optional[int], typer.Option(
              '--seed', min=0, max=2**31 - 1, help='Of everything random.')] = None,
          memory: Annotated[Optional[bool], typer.Option(
              '--memory', help='The policy also sees the estimated disturbance.')] = None,
          device: Annotated[str, typer.Option('--device', help='auto, cpu, cuda[:N].')] = 'auto',
          resume: Annotated[Optional[Path], typer.Option(
              '--resume', metavar='DIR', help="Go on from a run's last checkpoint, or from a "
                                              'model_N.pt.')] = None,
          smoke: Annotated[bool, typer.Option(
              '--smoke', help='Tiny sizes: does everything fit together?')] = False,
          stop_after: Annotated[Optional[float], typer.Option(
              '--stop-after', min=0, metavar='SECONDS', help='Stop training early.')] = None,
          robot: RobotOption = None, json_path: JsonOption = None):
    """
    Train a policy and export it to ONNX; needs the extra 'train', and a GPU to be useful.

    Several GPUs: torchrun --nproc-per-node N -m beetle_omni_ros.cli train --output DIR
    """
    from beetle_omni_ros.train.command import run_train, TrainingError
    from beetle_omni_ros.train.run_folder import parse_changes
    try:
        run_train(output=output, config=config, robot=robot, device=device, resume=resume,
                  changes=parse_changes(changes or [], seed=seed, memory=memory),
                  smoke=smoke, stop_after=stop_after, json_path=json_path)
    except TrainingError as error:
        raise typer.Exit(_fail(error, FAILED)) from None


def _check(*, task, seed, conditions, bag, json_path, files):
    """Refuse unusable input before anything long starts."""
    from beetle_omni_ros.runs.json_file import check_writable
    from beetle_omni_ros.runs.tasks import make_task
    if conditions not in CONDITIONS:
        raise ParameterError(f"--conditions '{conditions}': expected {' or '.join(CONDITIONS)}")
    for file in files:
        if file is not None and not file.is_file():
            raise ParameterError(f'{file}: no such file')
    make_task(task, seed)
    if json_path:
        check_writable(json_path)
    if bag:
        from beetle_omni_ros.runs.bag import check_new
        check_new(bag)


def _fail(error, status):
    print(f"beetle_omni: error: {' '.join(str(error).split())}", file=sys.stderr)
    return status


def main(args: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    try:
        status = get_command(app).main(args=args, prog_name='beetle_omni', standalone_mode=False)
        return status if isinstance(status, int) else 0
    except ModuleNotFoundError as error:
        top = (error.name or '').partition('.')[0]
        if top == __package__:
            raise
        cure = 'pip install beetle_omni_ros brings it'
        if top in ROS_MODULES or top.endswith(ROS_ENDINGS):
            cure = "source a ROS 2 Jazzy environment or pip install 'beetle_omni_ros[ros]'"
        elif top in TRAIN_MODULES:
            cure = "pip install 'beetle_omni_ros[train]'"
        return _fail(f"the module '{top}' is not installed; {cure}", UNUSABLE)
    except ParameterError as error:
        return _fail(error, UNUSABLE)
    except (KeyboardInterrupt, typer.Abort):
        return _fail('interrupted', INTERRUPTED)
    except Exception as error:
        # usage errors of typer's parser, and bag errors, without importing either for --help
        if hasattr(error, 'format_message'):
            text = error.format_message()  # empty after the help of a bare `beetle_omni`
            return _fail(f'{text} See beetle_omni --help.', UNUSABLE) if text else UNUSABLE
        if type(error).__name__ == 'BagError':
            return _fail(error, UNUSABLE)
        raise


def run() -> None:
    """Entry point of the console script."""
    sys.exit(main())


if __name__ == '__main__':
    run()
