"""A flight as one picture, for a computer without a browser: path, robot and errors."""

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.bags.log import FlightLog, geodesic_angles, motion
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import FLYING
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.figures import COLOURS, FAINT, INK, PARTS, STYLE
from beetle_omni_ros.show.scene import moments

RATE = 20.0         # [Hz] of the lines
MOST_ROBOTS = 10    # drawn along the path
RADIUS = 0.13       # [m] of a drawn rotor
CIRCLE = np.linspace(0, 2 * np.pi, 25)
TINY = 1e-5         # [m, deg] floor of the errors
DOTS = 110          # per inch


def write_picture(log: FlightLog, file: Path, title: str) -> None:
    """Write a PNG of a flight; an OSError reports a file that cannot be written."""
    body, zero = motion(log), log.begin
    times = np.arange(body.t[0], body.t[-1], 1 / RATE)
    shown = [(t, moment) for t, moment in zip(times, moments(log, times)) if moment]
    flown = [(t, moment) for t, moment in shown if moment.state.startswith(FLYING)] or shown
    aimed = [(t - zero, np.linalg.norm(moment.position - moment.target[0]), np.degrees(
        geodesic_angles(moment.quaternion[None], moment.target[1])[0]))
        for t, moment in flown if moment.target]
    with rc_context(STYLE):
        figure = Figure((11.0, 5.2), layout='constrained')
        figure.suptitle(title, fontsize=10, color=INK)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
        _draw_robots(figure.add_subplot(grid[:, 0], projection='3d'), log, shown, flown)
        for row, label in enumerate(('distance to the target [m]', 'angle to the target [deg]')):
            axes = figure.add_subplot(grid[row, 1])
            if aimed:
                t, *errors = np.array(aimed).T
                axes.semilogy(t, np.maximum(errors[row], TINY), color=COLOURS[0])
            axes.set(title=label, xlabel='time since the first target [s]' if row else '')
        figure.savefig(file, dpi=DOTS)


def _draw_robots(axes, log, shown, flown):
    """The path, its shadow on the floor, and robots at the ends of the targets."""
    path = np.array([moment.position for _, moment in shown])
    axes.plot(*path.T, color=COLOURS[0], linewidth=0.8)
    axes.plot(*path[:, :2].T, 0, color=FAINT, linewidth=0.5, alpha=0.6)
    t = np.array([t for t, _ in flown])
    ends = np.array([*(target.stamp for target in log.targets[1:]), t[-1]]) - 2 / RATE
    if len(log.targets) < 2:
        ends = np.linspace(t[0], t[-1], MOST_ROBOTS)
    rotors = RobotParameters.load().rotors.positions
    for k in np.unique(np.searchsorted(t, ends[:MOST_ROBOTS]).clip(0, len(t) - 1)):
        _draw_robot(axes, flown[k][1], rotors)
    low, high = path.min(axis=0) - 0.4, path.max(axis=0) + 0.4
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(0, high[2]),
             xlabel='x [m]', ylabel='y [m]', zlabel='z [m]')
    axes.set_box_aspect((*(high - low)[:2], high[2]), zoom=1.15)


def _draw_robot(axes, moment, rotors):
    """Arms and tilted rotors."""
    turned = rotations.matrix(moment.quaternion)
    for rotor, tilt, colour in zip(rotors, moment.tilt, PARTS):
        arm = np.append(rotor[:2], 0) / np.linalg.norm(rotor[:2])
        side, up = np.cross([0, 0, 1], arm), np.array([0, 0, 1.0])
        lifted = np.cos(tilt) * side + np.sin(tilt) * up
        disc = rotor + RADIUS * (np.outer(np.cos(CIRCLE), arm) + np.outer(np.sin(CIRCLE), lifted))
        for line, shade in ((np.array([np.zeros(3), rotor]), INK), (disc, colour)):
            axes.plot(*(moment.position + line @ turned.T).T, color=shade, linewidth=1.1)
