"""
Fly and draw the pictures of the pages: ``python docs/make_pictures.py [NAME...]``.

Without a name all are drawn that are stale: their function, the table of colours or a file that
they read has changed. ``docs/pictures/inputs.json`` has the digests, and test/docs compares them.
``hardware_flight`` needs ROS, films need an off-screen OpenGL, ``view`` a browser on the PATH.
Those of OTHERS have another command, which is printed if they are stale; a name then records that
it has been run.
"""

from __future__ import annotations

from collections.abc import Callable
import inspect
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile

import drawings
import film
import matplotlib
from matplotlib.figure import Figure
import numpy as np

import beetle_omni_ros as bo
from beetle_omni_ros.bags.log import motion
from beetle_omni_ros.flight import comparison_page
from beetle_omni_ros.flight.campaign import digest
from beetle_omni_ros.identify.flights.picture import picture_of
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show import figures
from beetle_omni_ros.show.figures import AFTER, BEFORE, colours_of, FAINT, INK, PARTS, STYLE
from beetle_omni_ros.show.recorded import recorded_scene

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
INPUTS = DOCS / 'pictures' / 'inputs.json'
DOTS = 110      # per inch
POSE = 8.0      # [s] of a pose
TASK = 'random2'
BROWSERS = 'chromium', 'chromium-headless-shell', 'google-chrome'
SOFTWARE = '--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'
PLAYS = "parseFloat(document.querySelector('.mantine-NumberInput-input')?.value) > 1"
MOMENT = 0.165          # of the flight, between two waypoints
WAIT, SETTLED = 120_000, 6_000  # ms


def figure(columns, height=2.9):
    """Axes beside each other, and their figure."""
    drawn = Figure((8.0, height), layout='constrained')
    return drawn, np.atleast_1d(drawn.subplots(1, columns))


def flown(log, end=None):
    """Times since the first target [s], positions, quaternions and the targets' errors."""
    body, start = motion(log), log.targets[0].stamp
    keep = (body.t >= start) & (body.t <= start + (end or np.inf))
    rows = np.flatnonzero(keep)
    times = body.t[rows]
    position, angle = np.zeros((2, len(rows)))
    stamps = np.array([target.stamp for target in log.targets])
    for k, row in enumerate(rows):
        aim = log.targets[np.searchsorted(stamps, times[k], 'right') - 1].at(float(times[k]))
        position[k] = np.linalg.norm(body.position[row] - aim.position)
        angle[k] = rotations.geodesic_angle(body.quaternion[row], aim.quaternion)
    return times - start, body.position[rows], position, np.degrees(angle)


def named(axes, title, x, y):
    """Title and labels."""
    axes.set(title=title, xlabel=x, ylabel=y)


def drawn_errors(logs, title, end):
    """Position and attitude errors of several flights against time."""
    drawn, (left, right) = figure(2)
    for (label, log), colour in zip(logs.items(), colours_of(logs.values())):
        times, _, position, angle = flown(log, end)
        left.semilogy(times, position, color=colour, label=label)
        right.semilogy(times, angle, color=colour, label=label)
    named(left, title, 'time [s]', 'distance from the target [m]')
    named(right, '', 'time [s]', 'angle to the target [deg]')
    left.legend()
    return drawn


def first_flight():
    """Errors of both controllers at the poses."""
    return drawn_errors({name: bo.simulate(name, TASK) for name in ('nmpc', 'rl')},
                        'Two random poses', 2 * POSE)


def blocks_of(page, language):
    """Blocks of a tutorial in a language."""
    text = (ROOT / 'docs' / 'tutorials' / f'{page}.md').read_text()
    return [part.partition('```')[0] for part in text.split(f'```{language}\n')[1:]]


def own_trajectory():
    """The circle of the tutorial from above, and the errors."""
    scope: dict = {}
    exec(blocks_of('own_trajectory', 'python')[0].partition('results =')[0], scope)
    drawn, (left, right) = figure(2, 3.2)
    logs = {name: bo.simulate(name, scope['task']) for name in ('nmpc', 'rl')}
    for (name, log), colour in zip(logs.items(), colours_of(logs.values())):
        times, path, position, _ = flown(log)
        on = times > POSE
        left.plot(path[on, 0], path[on, 1], color=colour, label=name)
        right.plot(times[on] - POSE, 1000 * position[on], color=colour, label=name)
    left.plot(*scope['positions'][:, :2].T, color=FAINT, linestyle=':', label='asked for')
    left.set_aspect('equal')
    left.legend()
    named(left, 'The path from above', 'x [m]', 'y [m]')
    named(right, 'Distance from the path', 'time [s]', 'error [mm]')
    return drawn


def own_controller():
    """Errors of the tutorial's two laws and of the NMPC."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / 'mine.py').write_text(blocks_of('own_controller', 'python')[0])
        return drawn_errors({
            label: bo.simulate(name, TASK) for label, name in (
                ('Mine', f'{folder}/mine.py:Mine'), ('Stiffer', f'{folder}/mine.py:Stiffer'),
                ('nmpc', 'nmpc'))}, 'Two random poses', 2 * POSE)


def own_robot():
    """Errors with the right file, the wrong one, and one with the right time constant."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'heavy.yaml').write_text(blocks_of('own_robot', 'yaml')[0])
        for command in blocks_of('own_robot', 'sh')[:2]:
            subprocess.run(['bash', '-ec', command], cwd=folder, check=True,
                           stdout=subprocess.DEVNULL, env={**os.environ, 'PATH': os.pathsep.join(
                               [str(Path(sys.executable).parent), os.environ['PATH']])})
        return drawn_errors({name: bo.read_run(folder / name)
                             for name in ('known', 'wrong', 'slow')}, 'Two poses', 2 * POSE)


def real_gap():
    """Disagreement and sizes of three real flights, as on the page of `gap`."""
    return picture_of(bo.find_gap(
        sorted((ROOT / 'test/data/nanobench').glob('*.csv.gz')), form='nanobench',
        robot=ROOT / 'params' / 'crazyflie.yaml', quiet=True))


def hardware_flight():
    """Tilt angles and pack voltage of a flight through emulated devices."""
    from beetle_omni_ros.ros.fly import run_fly
    with tempfile.TemporaryDirectory() as name:
        poses = Path(name) / 'first.csv'
        poses.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0,0,1,0,0,0\n0,0,1.2,45,0,0\n')
        run_fly(task=str(poses), bag=Path(name) / 'bag', actuators='emulated')
        log = bo.read_run(Path(name) / 'bag')
    start = log.targets[0].stamp
    drawn, (left, right) = figure(2)
    for k, colour in enumerate(PARTS):
        left.plot(log.joint.t - start, np.degrees(log.joint.position[:, k]), color=colour,
                  label=f'gimbal{k + 1}')
        left.plot(log.command.t - start, np.degrees(log.command.tilt[:, k]), color=colour,
                  linestyle=':')
    left.legend(ncols=2)
    left.set_xlim(6, 12)
    named(left, 'Tilt, measured (line) and asked for (dots)', 'time [s]', 'angle [deg]')
    right.plot(log.battery.t - start, log.battery.voltage, color=INK)
    named(right, 'Pack', 'time [s]', 'voltage [V]')
    return drawn


def flight():
    """Film of both controllers at the waypoints and upside down."""
    return [film.panel(bo.simulate(name, film.task()), label)
            for name, label in (('rl', 'RL'), ('nmpc', 'NMPC'))]


def gap():
    """Film of a flight with a weak rotor, and what the model expects before and after `gap`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plant, corrected = folder / 'plant.yaml', folder / 'corrected.yaml'
        plant.write_text('extends: robot.yaml\n'
                         'effects: {rotor_thrust_coefficient: {scale: [1, 1, 0.9, 1]}}\n')
        for seed in range(3):
            bo.simulate('nmpc', 'random8', plant=plant, seed=seed, bag=folder / f'{seed}')
        bo.find_gap([folder / f'{seed}' for seed in range(3)], apply=corrected, quiet=True)
        log = bo.simulate('nmpc', film.task(), plant=plant)
        return [film.panel(log, 'model of the file', RobotParameters.load(), BEFORE),
                film.panel(log, 'corrected model', RobotParameters.load(corrected), AFTER)]


def view():
    """Photograph of `beetle_omni view` with both controllers at the waypoints."""
    from playwright.sync_api import sync_playwright
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    with tempfile.TemporaryDirectory() as name, sync_playwright() as started:
        page = Path(name) / 'page.html'
        page.write_text(recorded_scene({name: bo.simulate(name) for name in ('rl', 'nmpc')}))
        shown = started.chromium.launch(executable_path=browser, args=SOFTWARE).new_page(
            viewport={'width': 1000, 'height': 560})
        shown.goto(page.as_uri(), timeout=WAIT)
        shown.wait_for_function(PLAYS, timeout=WAIT)
        shown.locator('button.mantine-ActionIcon-root').first.click()   # pause
        bar = shown.locator('.mantine-Slider-track').bounding_box()
        shown.mouse.click(bar['x'] + MOMENT * bar['width'], bar['y'] + bar['height'] / 2)
        shown.wait_for_timeout(SETTLED)
        return shown.screenshot(timeout=WAIT)


# Picture below docs/ -> its function, and the files that it reads.
TUTORIALS, SHIPPED = 'tutorials/pictures', ('policies/rl.onnx', 'params/robot.yaml')
PICTURES: dict[str, tuple[Callable, tuple[str, ...]]] = {
    **{f'{TUTORIALS}/{made.__name__}.png': (made, read) for made, read in (
        (first_flight, ()), (own_trajectory, ('docs/tutorials/own_trajectory.md',)),
        (own_controller, ('docs/tutorials/own_controller.md',)),
        (own_robot, ('docs/tutorials/own_robot.md',)),
        (real_gap, ('params/crazyflie.yaml', 'test/data/nanobench/*.csv.gz')),
        (hardware_flight, ()))},
    'pictures/flight.gif': (flight, SHIPPED), 'pictures/gap.gif': (gap, SHIPPED),
    'pictures/view.png': (view, ('beetle_omni_ros/show/scene.py',
                                 'beetle_omni_ros/show/viewer.html')),
    **{f'pictures/{made.__name__}.svg': (made, read) for made, read in (
        (drawings.architecture, ('beetle_omni_ros/ros/graph.py',)),
        (drawings.real_flights, ('params/crazyflie.yaml', 'test/data/nanobench/*.csv.gz')),
        (drawings.frames, ('params/robot.yaml',)), (drawings.wiring, ()))}}
# Pattern below docs/ -> the command that draws other pictures, and the functions that do it.
OTHERS: dict[str, tuple[str, tuple[Callable, ...]]] = {
    'comparison/*_convergence_*.png': ('make compare', (
        comparison_page.convergence, figures.legend)),
    'comparison/*_errors_*.png': ('make compare', (comparison_page.in_time, figures.legend))}


def sources(function: Callable) -> str:
    """Text of a class, or of a function and the functions of its file that it calls."""
    if inspect.isclass(function):
        return inspect.getsource(function)
    names, texts, known = [function.__name__], [], function.__globals__
    for name in names:
        texts.append(inspect.getsource(known[name]))
        names += [other for other in known[name].__code__.co_names if other not in names
                  and inspect.isfunction(known.get(other))
                  and known[other].__module__ == function.__module__]
    return ''.join(texts)


def inputs(name: str) -> str:
    """Digest of everything that decides a picture, except for most of the package itself."""
    function, read = PICTURES.get(name, (None, ()))
    drawn_by = (function,) if function else next(
        drawn_by for pattern, (_, drawn_by) in OTHERS.items() if Path(name).match(pattern))
    text = ''.join(map(sources, drawn_by))
    colours = figures.LINES, PARTS, BEFORE, AFTER, INK, FAINT, STYLE
    return digest(text, repr(colours), *([inspect.getsource(film)] if 'film.' in text else []),
                  *(b''.join(re.findall(b'```.*?```', path.read_bytes(), re.S))
                    if path.suffix == '.md' else path.read_bytes()     # the code of a page
                    for pattern in read for path in sorted(ROOT.glob(pattern))))


def commands() -> dict[str, str]:
    """Every picture that has an entry -> the command that draws it."""
    return {**{name: f'python docs/make_pictures.py {Path(name).stem}' for name in PICTURES},
            **{path.relative_to(DOCS).as_posix(): command for pattern, (command, _) in
               OTHERS.items() for path in sorted(DOCS.glob(pattern))}}


def recorded() -> dict[str, str]:
    """Digests of the inputs with which pictures were drawn."""
    return json.loads(INPUTS.read_text(encoding='utf-8'))


def stale() -> dict[str, str]:
    """Pictures whose recorded digest is not that of their inputs, with their commands."""
    known = recorded()
    return {name: command for name, command in commands().items()
            if known.get(name) != inputs(name)}


def main(names):
    """Draw pictures whose name is given, or all stale ones; record the inputs of those drawn."""
    for name, command in commands().items():
        if Path(name).stem not in names and (names or name not in stale()):
            continue
        if name in PICTURES:
            with matplotlib.rc_context({**STYLE, 'svg.fonttype': 'none', 'svg.hashsalt': name}):
                made = PICTURES[name][0]()
                if isinstance(made, Figure):
                    made.savefig(DOCS / name, dpi=DOTS, **(
                        {'metadata': {'Date': None}} if name.endswith('svg') else
                        {'pil_kwargs': {'optimize': True}}))
                elif isinstance(made, bytes):
                    (DOCS / name).write_bytes(made)
                else:
                    film.write(DOCS / name, made)
        elif not names:     # a name confirms that it was drawn
            print(f'stale: {name}: {command}, then python docs/make_pictures.py {Path(name).stem}')
            continue
        INPUTS.write_text(json.dumps(recorded() | {name: inputs(name)}, indent=1) + '\n')
        print(DOCS / name)


if __name__ == '__main__':
    main(sys.argv[1:])
