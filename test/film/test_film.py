"""Films: the view contains the flight, wrong models drift, files can be played."""

import os
import subprocess
import sys

import numpy as np
from PIL import Image, ImageSequence
import pytest
from rich.console import Console

from beetle_omni_ros import cli
from beetle_omni_ros.evaluation.command import run_evaluate
from beetle_omni_ros.film.command import (
    camera,
    CAPTION,
    FIELD_OF_VIEW,
    free_run,
    HEIGHT,
    RESTART,
    ROBOT_RADIUS,
)
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.body import geodesic_angles, motion
from beetle_omni_ros.runs.tasks import pose_target, Segment, Task

POSES = np.array([[0, 0, 1.0, 0, 0, 0], [0.6, 0.3, 1.2, 0, 30, 40]])


def film(*arguments, **environment):
    """Run `beetle_omni film` in a new process, because MuJoCo selects its OpenGL once."""
    return subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros.cli', 'film', *map(str, arguments)], timeout=240,
        capture_output=True, text=True, env={**os.environ, **environment})


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A short recorded flight."""
    folder = tmp_path_factory.mktemp('film') / 'one flight'
    task = Task('short', 'poses', tuple(
        Segment(1.5, lambda start, pose=pose: pose_target(pose, start)) for pose in POSES), POSES)
    run_evaluate(controllers=['nmpc'], task=task, bag=folder, console=Console(quiet=True))
    return folder


@pytest.mark.parametrize('seed', range(5))
def test_the_camera_view_contains_the_whole_flight(seed):
    random = np.random.default_rng(seed)
    points = random.uniform(-1, 1, (40, 3)) * random.uniform(0.01, 3, 3) + random.uniform(-2, 2, 3)
    view = camera(points)
    azimuth, elevation = np.radians([view.azimuth, view.elevation])
    # Definition of MuJoCo: the camera looks along these angles from a distance.
    look = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation)])
    side = np.cross(look, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    seen = points - (np.array(view.lookat) - view.distance * look)
    depth, tangent = seen @ look, np.tan(np.radians(FIELD_OF_VIEW / 2))
    height = seen @ np.cross(side, look) / depth / tangent
    assert (depth > ROBOT_RADIUS).all()
    assert height.min() > -1 and height.max() < 1 - 2 * CAPTION / HEIGHT
    assert np.abs(seen @ side / depth / tangent).max() < 1.2


def test_the_true_model_follows_the_flight_and_a_wrong_one_drifts_until_restarted(
        bag, tmp_path):
    log, flown = read_bag(bag), motion(read_bag(bag))
    heavy = tmp_path / 'heavy.yaml'
    heavy.write_text(f"extends: {share_path('params/robot.yaml')}\neffects: {{mass: {{mass: 3.3}}"
                     '}\n')
    for file, least, most in ((None, 0.0, 1e-3), (heavy, 0.05, 1.0)):
        model = free_run(log, RobotParameters.load(file))
        k = np.searchsorted(flown.t, model.t - 1e-6)
        since = model.t - log.targets[0].stamp
        away = np.linalg.norm(model.position - flown.position[k], axis=1)
        turned = geodesic_angles(model.quaternion, flown.quaternion[k])
        part, flying = since % RESTART / RESTART, (since >= 0) & (since < 2.95)
        late, early = flying & (part > 0.9) & (part < 0.99), flying & (part < 0.01)
        assert least <= away[late].min() and away[late].max() <= most
        assert away[early].max() < 0.002 and turned[early].max() < 0.02


def test_a_film_shows_robot_and_targets_move(bag, tmp_path):
    out, model = tmp_path / 'a.gif', share_path('params/robot.yaml')
    for given in (), ('--model', model):
        done = film(bag, '-o', out, *given)
        if 'no off-screen OpenGL' in done.stderr:
            pytest.skip(done.stderr)
        assert done.returncode == 0, done.stderr
        with Image.open(out) as made:
            assert made.info['loop'] == 0 and made.info['duration'] == 80
            frames = [np.asarray(frame.convert('RGB')).astype(int)
                      for frame in ImageSequence.Iterator(made)]
        first, last = (frame[CAPTION:HEIGHT] for frame in (frames[17], frames[24]))
        assert (np.abs(first - last).max(axis=2) > 60).sum() > 80
        # Sky and floor are blue; only the front rotors and arms are reddish. Their
        # brightness depends on the OpenGL, their hue does not.
        reddish = first[..., 0] - first[..., 1:].max(axis=2) > 20
        assert reddish.sum() > 80


def test_without_graphics_one_line_names_the_packages(bag, tmp_path):
    done = film(bag, '-o', tmp_path / 'a.gif', MUJOCO_GL='off')
    lines = done.stderr.splitlines()
    assert done.returncode == 2 and len(lines) == 1 and 'libopengl0' in lines[0], done.stderr


@pytest.mark.parametrize(('arguments', 'expected'), [
    (('-o', 'a.mp4'), '.gif'), (('-o', 'a.gif', '--model', 'none.yaml'), 'none.yaml'),
    (('-o', 'none/a.gif'), 'none/a.gif')])
def test_unusable_input_is_one_line(bag, tmp_path, monkeypatch, capsys, arguments, expected):
    monkeypatch.chdir(tmp_path)
    assert cli.main(['film', str(bag), *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and expected in lines[0], lines
    assert not list(tmp_path.iterdir())
