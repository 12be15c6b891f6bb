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
from beetle_omni_ros.film import files, graphics
from beetle_omni_ros.film.frames import CAPTION, FIELD_OF_VIEW, framing, ROBOT_RADIUS
from beetle_omni_ros.film.free_runs import free_runs, RESTART
from beetle_omni_ros.film.scenes import target_scene
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
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
    camera = framing(points)
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    # Definition of MuJoCo: the camera looks along these angles from a distance.
    look = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                     np.sin(elevation)])
    side = np.cross(look, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    seen = points - (np.array(camera.lookat) - camera.distance * look)
    depth, tangent = seen @ look, np.tan(np.radians(FIELD_OF_VIEW / 2))
    height = seen @ np.cross(side, look) / depth / tangent
    assert (depth > ROBOT_RADIUS).all()
    assert height.min() > -1 and height.max() < 1 - CAPTION
    assert np.abs(seen @ side / depth / tangent).max() < 1.2


def test_the_true_model_follows_the_flight_and_a_wrong_one_drifts_until_restarted(
        bag, tmp_path):
    log, flown = read_bag(bag), motion(read_bag(bag))
    heavy = tmp_path / 'heavy.yaml'
    heavy.write_text(f"extends: {share_path('params/robot.yaml')}\neffects: {{mass: {{mass: 3.3}}"
                     '}\n')
    for file, least, most in ((None, 0.0, 1e-3), (heavy, 0.05, 1.0)):
        model = free_runs(log, RobotParameters.load(file))
        k = np.searchsorted(flown.t, model.t - 1e-6)
        since = model.t - log.targets[0].stamp
        away = np.linalg.norm(model.position - flown.position[k], axis=1)
        turned = geodesic_angles(model.quaternion, flown.quaternion[k])
        part, flying = since % RESTART / RESTART, (since >= 0) & (since < 2.95)
        late, early = flying & (part > 0.9) & (part < 0.99), flying & (part < 0.01)
        assert least <= away[late].min() and away[late].max() <= most
        assert away[early].max() < 0.002 and turned[early].max() < 0.02


def test_a_scene_contains_the_error_to_the_target_in_force(bag):
    log = read_bag(bag)
    times = log.targets[0].stamp + np.arange(0.0, 3.0, 0.1)
    scene = target_scene(log, 'flight', '#102030', times, RobotParameters.load())
    jump = np.argmax(np.diff(scene.position)) + 1
    assert times[jump] - log.targets[1].stamp == pytest.approx(0, abs=0.1)
    assert scene.position[jump] == pytest.approx(np.linalg.norm([0.6, 0.3, 0.2]), abs=0.05)
    assert scene.position[-1] < 0.1 and scene.orientation[-1] < 10
    assert scene.notes[0].endswith('level') and 'pitch 30°' in scene.notes[-1]
    assert scene.ghosts[-1].position == pytest.approx(POSES[1, :3])


def test_a_gif_contains_the_drawn_frames(tmp_path):
    pictures = []
    for k in range(6):
        picture = np.full((40, 60, 3), (230, 236, 244), np.uint8)
        picture[10:20, 8 * k:8 * k + 10] = (200, 30, 20)
        pictures.append(Image.fromarray(picture))
    files.write_film(tmp_path / 'a.gif', pictures, 12.5)
    with Image.open(tmp_path / 'a.gif') as film:
        assert film.info['loop'] == 0 and film.n_frames == 6
        for drawn, frame in zip(pictures, ImageSequence.Iterator(film), strict=True):
            assert frame.info['duration'] == 80
            shown = np.asarray(frame.convert('RGB')).astype(int)
            assert np.abs(shown - np.asarray(drawn)).max() < 12


def test_a_film_shows_the_robot_move(bag, tmp_path):
    try:
        graphics.choose_backend()
    except ParameterError as error:
        pytest.skip(str(error))
    finally:
        os.environ.pop('MUJOCO_GL', None)
    out, size = tmp_path / 'a.gif', 320
    model = share_path('params/robot.yaml')
    for given, panels in (((), 1), (('--model', model, '--model', model), 2)):
        done = film(bag, '-o', out, '--size', size, '--start', 1.4, '--duration', 0.5, *given)
        assert done.returncode == 0, done.stderr
        with Image.open(out) as made:
            frames = [np.asarray(frame.convert('RGB')).astype(int)
                      for frame in ImageSequence.Iterator(made)]
        assert len(frames) == 7 and frames[0].shape[1] == size * panels
        for panel in range(panels):
            first, last = (
                frame[3 * size // 10:17 * size // 20, size * panel:size * (panel + 1)]
                for frame in (frames[0], frames[-1]))
            assert (np.abs(first - last).max(axis=2) > 60).sum() > 80
            # Sky and floor are blue; only the front rotors and arms are reddish. Their
            # brightness depends on the OpenGL, their hue does not.
            reddish = first[..., 0] - first[..., 1:].max(axis=2) > 20
            assert reddish.sum() > 80


def test_without_graphics_one_line_names_the_packages(bag, tmp_path):
    done = film(bag, '-o', tmp_path / 'a.gif', MUJOCO_GL='none')
    lines = done.stderr.splitlines()
    assert done.returncode == 2 and len(lines) == 1 and 'libopengl0' in lines[0], done.stderr


@pytest.mark.parametrize(('arguments', 'expected'), [
    (('-o', 'a.avi'), '.gif or .mp4'), (('-o', 'a.gif', '--model', 'none.yaml'), 'none.yaml'),
    (('-o', 'none/a.gif'), 'none/a.gif'), (('-o', 'a.gif', '--size', '201'), 'even'),
    (('-o', 'a.gif', '--start', '1e4'), '--start'), (('-o', 'a.gif', '--start', 'nan'), '--start'),
    (('-o', 'a.gif', '--duration', '0'), '--duration')])
def test_unusable_input_is_one_line(bag, tmp_path, monkeypatch, capsys, arguments, expected):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(graphics, 'choose_backend', lambda: 'none')
    assert cli.main(['film', str(bag), *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and expected in lines[0], lines
    assert not list(tmp_path.iterdir())
