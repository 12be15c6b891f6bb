"""Recorded runs in Rerun, which reads the MCAP file of a bag: blueprint, meshes and errors."""

from contextlib import contextmanager
import os
from pathlib import Path
import tempfile

from beetle_omni_ros.bags.bag import read_flights
from beetle_omni_ros.bags.log import FlightLog, target_errors
from beetle_omni_ros.model.resources import PACKAGE, share_path
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.show.figures import COLOURS

APPLICATION = 'beetle_omni'     # of the recordings and of viewers/rerun.rbl, which must agree
PACKAGES = 'ROS_PACKAGE_PATH'   # where Rerun finds package:// of the meshes
TIMELINE = 'message_log_time'   # of Rerun's MCAP reader
ERRORS = {'error/position': 'position error [m]', 'error/orientation': 'orientation error [deg]'}
# Title -> topics, with the field of a JointState.
PLOTS = {'tilt [rad]: measured and commanded': ['joint_states/position', 'command/position'],
         'thrust command [N]': ['command/effort'], 'battery': ['battery_state'],
         'IMU': ['imu/data_raw']}
STATES = {'supervisor': 'supervisor/state', 'task': 'reference/state'}
WORLD, TARGET, AXES = 'world', 'target', 0.28       # frames; [m]


def run_rerun(runs: list[Path]) -> None:
    """Open recorded runs in Rerun; a ParameterError reports unusable input or no rerun-sdk."""
    try:
        import rerun
    except ImportError:
        raise ParameterError("--rerun: needs Rerun: pip install 'rerun-sdk>=0.34,<1'") from None
    if not any(map(os.environ.get, ('DISPLAY', 'WAYLAND_DISPLAY'))):     # it would wait for ever
        raise ParameterError('--rerun: no display; expected DISPLAY or WAYLAND_DISPLAY')
    logs = read_flights(runs, len(COLOURS))
    with meshes():
        for name, log in logs.items():
            recording = rerun.RecordingStream(APPLICATION, recording_id=name)
            recording.spawn(default_blueprint=blueprint())     # reuses the first one's window
            send(log, recording)


def send(log: FlightLog, recording) -> None:
    """Send the bag of a flight and its errors from the targets to a recording of Rerun."""
    import rerun
    for file in sorted(Path(log.source).glob('*.mcap')) or [Path(log.source)]:
        recording.log_file_from_path(file)
    recording.log(TARGET, rerun.CoordinateFrame(TARGET), rerun.TransformAxes3D(AXES), static=True)
    t, *away = target_errors(log)
    for name, values in zip(ERRORS, away, strict=True):
        recording.send_columns(name, [rerun.TimeColumn(TIMELINE, timestamp=t)],
                               rerun.Scalars.columns(scalars=values))
    for target in log.targets:
        reference = target.at(target.stamp)
        recording.set_time(TIMELINE, timestamp=target.stamp)
        recording.log(TARGET, rerun.Transform3D(
            translation=reference.position, quaternion=reference.quaternion,
            parent_frame=WORLD, child_frame=TARGET))
    recording.flush()


def blueprint():
    """Return the layout: robot, targets, errors, tilts, thrusts, sensors and states."""
    import rerun.blueprint as rrb
    lines = {title: [name] for name, title in ERRORS.items()} | PLOTS
    plots = [rrb.TimeSeriesView(origin='/', contents=[f'/{name}' for name in names], name=title)
             for title, names in lines.items()]
    states = [rrb.TextDocumentView(origin=f'/{topic}', name=title)
              for title, topic in STATES.items()]
    robot = rrb.Spatial3DView(
        origin='/', name='robot and target', contents=['+ /**', '- /**/collision_geometries/**'],
        spatial_information=rrb.SpatialInformation(target_frame=WORLD))
    left = rrb.Vertical(robot, rrb.Horizontal(*states), row_shares=[5, 1])
    return rrb.Blueprint(rrb.Horizontal(left, rrb.Vertical(*plots)),
                         rrb.TimePanel(timeline=TIMELINE, expanded=False), collapse_panels=True)


@contextmanager
def meshes():
    """Let Rerun find the meshes of this package while the context lasts."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / PACKAGE).symlink_to(share_path('description').parent)
        os.environ[PACKAGES] = os.pathsep.join(filter(None, [folder, os.environ.get(PACKAGES)]))
        yield
