"""
Formulas of `gap --learn` against hidden forces: ``python benchmarks/formulas.py --seed 0``.

Each body and rotor entry is left out of the catalogue and hidden in three flights, and so are ten
families outside it; undisturbed plants have no law. True states of the third flight judge.
``--baseline`` adds plain sparse regression (pysindy). The same command continues a run.
"""

import argparse
from collections import namedtuple
from contextlib import closing
from dataclasses import replace
import importlib.util
from pathlib import Path
import tempfile
from time import process_time

import casadi as ca
import numpy as np
from rich.console import Console
from scipy.signal import lfilter

from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.campaign import digest, SOURCE, Store, sweep
from beetle_omni_ros.flight.evaluate import prepared
from beetle_omni_ros.identify.flights import bag_flight, body, command, page, treatment
from beetle_omni_ros.identify.flights.keys import all_keys, ARM, extra_keys, LIMITS
from beetle_omni_ros.identify.recording import bag, flight, parameters
from beetle_omni_ros.model import dynamics, effects, formula, terms
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import mass_properties, RobotParameters
from beetle_omni_ros.model.parts import ThrustMap
from beetle_omni_ros.model.schema import ParameterError

LIKE, CLOSED = 0.95, 0.8    # least correlation and closure of a law that is rediscovered
LOW = 0.3                   # [m] the flight above counts
GAP = parameters.GapParameters.load()
UNDISTURBED, TRIES = 'undisturbed', 5   # draws of an effect until no flight is lost
OF_ONE = ' of one joint'    # end of the name of an effect that only one joint has
X, Y, Z = (ca.DM(row) for row in np.eye(3))
STATES = ('position', 'velocity', 'quaternion', 'angular_velocity', 'tilt', 'tilt_velocity',
          'thrust', 'stamp')     # true ones
Case = namedtuple('Case', 'name key cost kind effect number seed baseline')


def near(t, i, way, place):
    """Inverse square of the distance of a rotor from a wall or ceiling, 1 at 0.25 m."""
    return (0.25 / ca.fmax(place - ca.dot(way, t.position + t.rotation @ t.rotor_positions[i]),
                           0.2))**2


def beside(t, i, j):
    """Cosine between the jet of rotor j and the way from there to rotor i; 0: it blows away."""
    way = t.rotor_positions[i] - t.rotor_positions[j]
    return ca.fmax(-ca.dot(way, t.thrust_directions[j]), 0) / ca.norm_2(way)


# Name -> least size, and the force in world [N] of terms and size. All in SI units.
FORCES = {
    # elastic cord to a hook 3 m above the origin, slack below 1.2 m (Hooke)
    'tether': (0.8, lambda t, k: k * (3 * Z - t.position) * ca.fmax(
        1 - 1.2 / ca.norm_2(3 * Z - t.position), 0)),
    # weight of the lifted part of a cable
    'power_cable': (0.05, lambda t, k: -9.80665 * k * t.position[2] * Z),
    # drag between the laws of Stokes and Newton
    'power_drag': (0.6, lambda t, k: -k * t.velocity * ca.sumsqr(t.velocity)**0.25),
    # pressure on a flat plate in the plane of the arms
    'plate': (0.5, lambda t, k: -k * t.rotation[:, 2] * ca.dot(t.rotation[:, 2], t.velocity)
              * ca.fabs(ca.dot(t.rotation[:, 2], t.velocity))),
    # a fan blows along x, Gaussian with a deviation of 0.5 m
    'jet': (1.0, lambda t, k: k * X * ca.exp(-2 * ca.sumsqr(
        t.position[1:] - ca.DM([0.3, 1.2])))),
    # rotors draw the air from between themselves and a wall at y = 2.5 m
    'wall': (0.6, lambda t, k: k * Y * sum(t.thrust[i] * near(t, i, Y, 2.5) for i in range(4)))}
# Name -> least size, and the factor of the thrust of rotor i.
GAINS = {
    # as near the ground, of 2.6 m height
    'ceiling': (0.5, lambda t, k, i: 1 + k * near(t, i, Z, 2.6)),
    # a tilted neighbour disturbs the inflow
    'neighbour_tilt': (0.08, lambda t, k, i: 1 - k * ca.sin(t.tilt[(i + 1) % 4])**2),
    # less thrust in the jets of the others
    'wake': (0.1, lambda t, k, i: 1 - k * sum(
        beside(t, i, j)**4 * t.thrust[j] / t.hover_thrust for j in range(4) if j != i)),
    # blades twist under load
    'twist': (0.1, lambda t, k, i: (ca.fmax(t.thrust[i], 0.01) / t.hover_thrust)**-k)}


def family(name):
    """Effect of a force or of factors of thrust, for the catalogue."""
    def apply(t, size):
        if name in FORCES:
            t.force_world = t.force_world + FORCES[name][1](t, size)
        else:
            t.thrust = t.thrust * ca.vertcat(*(GAINS[name][1](t, size, i) for i in range(4)))
    return terms.Effect('body', {'size': terms.EffectParameter('SI', 0.0, 0.0, 10.0)}, name, apply)


KINDS = {'left_out': [
    name for name, entry in effects.CATALOGUE.items() if name in treatment.TREATMENTS
    and entry.layer in ('body', 'rotor') and entry.each != 'term' and not entry.beside],
    'outside': [*FORCES, *GAINS], UNDISTURBED: [UNDISTURBED]}


def drawn(name, robot, rng):
    """Parameters of an effect of 1 to 2 typical sizes, of a random sign or direction."""
    factor, name, one = rng.uniform(1, 2), name.removesuffix(OF_ONE), name.endswith(OF_ONE)
    entry, made = effects.CATALOGUE[name], {}
    if name in KINDS['outside']:
        return {'size': factor * (FORCES | GAINS)[name][0]}
    keys = [key for key in all_keys(robot).values() if key.effect == name and not key.form]
    way = rng.normal(size=len(keys))
    if entry.each:      # one rotor
        way *= np.arange(len(keys)) == rng.integers(len(keys))
    way = way / np.linalg.norm(way) if keys[-1].index else np.sign(way[:1]).repeat(len(keys))
    if entry.delays or name in LIMITS:
        way = np.full(len(keys), -1 if name in LIMITS else 1)
    for key, part in zip(keys, way, strict=True):
        spec, more = entry.parameters[key.parameter], factor * part * key.typical
        made.setdefault(key.parameter, []).append(float(key.value(
            more if spec.low <= key.value(more) <= spec.high else -more)))
    if one:
        joint, base = rng.integers(4), {key.parameter: key.base for key in keys}
        made = {key: [each[0] if k == joint else base[key] for k in range(4)]
                for key, each in made.items()}
    return {key: tuple(each) if len(each) > 1 else each[0] for key, each in made.items()}


def described(names, folder):
    """Robot that the flights are compared with, and its file; without modules that are hidden."""
    path = folder / 'own.yaml'
    path.write_text('extends: robot.yaml\n' + 'multibody: null\n' * ('module_reaction' in names))
    return RobotParameters.load(path), path


def hidden(names, robot, controller, tasks, rng, folder):
    """
    Draw effects until the robot is possible and no flight is lost.

    Returns:
        The plant, the bags, the last result of :func:`fly`, the number of lost draws.

    """
    for lost in range(TRIES):
        plant = replace(robot, effects={
            name.removesuffix(OF_ONE): drawn(name, robot, rng) for name in names})
        paths = [folder / f'{lost}_{k}' for k in range(len(tasks))]
        try:
            mass_properties(plant)
        except ParameterError:      # an inertia that no body has
            continue
        if all(flown := fly(controller, robot, plant, task, int(rng.integers(2**31)), path)
               for task, path in zip(tasks, paths, strict=True)):
            return plant, paths, flown, lost
    raise RuntimeError(f'{TRIES} flights are lost')


def fly(controller, robot, plant, task, seed, path):
    """True states at 200 Hz above LOW, and those with the thrusts of another robot; None: lost."""
    loop, rows = prepared(controller, robot=robot, plant=plant, seed=seed, bag=path), []
    simulator = loop.simulator

    def note():
        rows.append([*(np.array(getattr(simulator.truth, name)) for name in STATES),
                     simulator.battery.voltage])
    loop.before_messages = note
    with closing(loop):
        if not loop.fly(make_task(task, seed)):
            return None
        sent = loop.recording().command
    *states, tilt_rate, real, t, voltage = map(np.array, zip(*rows, strict=True))
    ratio, step, high = voltage / plant.battery.full_voltage, simulator.tick, states[0][:, 2] > LOW
    most = ThrustMap(robot.rotors).thrust_limit_below(ratio * robot.battery.full_voltage)

    def flown(other=None):
        """States, name -> (N, width); the thrusts are answers to the recorded commands."""
        thrust = real / plant.thrust_scale
        thrust_rate = np.gradient(thrust, step, axis=0)
        if other:
            rotors, late = other.rotors, GAP.command_delay + other.command_delays[1]
            at = np.searchsorted(sent.t + late, t + 1e-5, side='right') - 1
            aim = np.clip(sent.thrust[np.maximum(at, 0)], rotors.thrust_min, np.minimum(
                rotors.thrust_max, most[:, None]))
            gain = -np.expm1(-step / rotors.time_constant)
            thrust = lfilter([0, gain], [1, gain - 1], aim, axis=0)
            thrust_rate = (aim - thrust) / rotors.time_constant
        made = dict(zip(STATES, states, strict=False)) | {
            'tilt_rate': tilt_rate, 'tilt_acceleration': np.gradient(tilt_rate, step, axis=0),
            'thrust': thrust, 'thrust_rate': thrust_rate, 'voltage_ratio': ratio[:, None]}
        return {name: values[high] for name, values in made.items()}
    return flown


def wrench(robot, base, states):
    """(N, 6) force and torque over arm [N] in base_link of a robot file."""
    x = {name: ca.SX.sym(name, values.shape[1]) for name, values in states.items()}
    acceleration, turning = dynamics.rigid_body(robot, **x)
    made = ca.Function('wrench', list(x.values()), [ca.vertcat(
        base.mass * dynamics.rotation_matrix(x['quaternion']).T @ acceleration,
        ca.DM(base.inertia) * turning / ARM)])
    return np.array(made.map(len(states['thrust']))(*(values.T for values in states.values()))).T


def agreement(true, found):
    """Correlation of wrenches (N, 6) less their means, and found share of the true power."""
    a, b = (each - each.mean(axis=0) for each in (true, found))
    return {'correlation': float((a * b).sum() / max(
                np.sqrt((a**2).sum() * (b**2).sum()), 1e-9)),
            'share': float(1 - ((true - found)**2).sum() / max((true**2).sum(), 1e-9))}


def with_formula(robot, found):
    """The robot with a formula, term -> coefficient."""
    return replace(robot, effects={'formula': {
        'expressions': tuple(found), 'coefficients': tuple(found.values())}} if found else {})


def sparse(paths, robot):
    """Formula of flights by sequentially thresholded least squares, as the library comes."""
    from pysindy import STLSQ
    library, weight, x, y = formula.library(), robot.mass * robot.gravity, [], []
    known = with_formula(robot, dict.fromkeys(library, 0.0))
    keys = {**all_keys(known), **extra_keys(known)}
    model = body.BodyModel(known, keys, body.tilting_modules(robot))
    sizes = np.array([formula.size_of(term, weight, ARM) for term in library])
    units = np.array([robot.mass] * 3 + list(robot.inertia / ARM)) / (formula.SHARE * weight)
    for path in paths:
        own = flight.prepare(bag.read_recording(path), robot, GAP, False)
        made = bag_flight.BagFlight(own, known, model, keys, GAP)
        made.modules = float(robot.multibody is not None)
        linear = made.linear({}, [f'formula.coefficients[{k}]' for k in range(len(library))])
        use = made.mask[:, 0]
        y.append((units * linear.residual[use, :6]).ravel())
        x.append(-(units[:, None] * linear.slopes[use, :6] * sizes).reshape(-1, len(sizes)))
    found = STLSQ().fit(np.concatenate(x), np.concatenate(y)[:, None]).coef_.ravel() * sizes
    return {term: float(k) for term, k in zip(library, found, strict=True) if k}


def examined(case):
    """What `gap --learn` finds of the flights of a case, and how true it is."""
    # Of the module, because a worker has a copy of globals. Without a treatment no fit has them.
    effects.CATALOGUE.update({name: family(name) for name in KINDS['outside']})
    controller = ('nmpc', 'rl')[case.number % 2]
    return {'case': case.name, 'kind': case.kind, 'controller': controller,
            **attempted(compared, case, controller)}


def attempted(function, *given):
    """Row of a case by a function of it and an empty folder, or its failure; and CPU time."""
    began = process_time()
    try:
        with tempfile.TemporaryDirectory() as folder:
            row = function(*given, Path(folder))
    except Exception as error:      # of one case; the others continue
        row = {'failure': f'{type(error).__name__}: {error}'}
    return row | {'cpu_s': round(process_time() - began, 1)}


def compared(case, controller, folder):
    """Answers about three flights of a plant, and their correlations with the true force."""
    rng = np.random.default_rng([case.seed, list(KINDS).index(case.kind), case.number])
    names = [] if case.kind == UNDISTURBED else [case.effect]
    base, robot = described(names, folder)
    plant, paths, flown, lost = hidden(names, base, controller, ['random5'] * 3, rng, folder)
    without, corrected = folder / 'less.yaml', folder / 'corrected.yaml'
    without.write_text(f"without: [{case.effect * (case.kind == 'left_out')}]\n")
    result = command.gap_results(paths[:2], paths[2:], robot, corrected, parameters=without,
                                 learn=folder / 'effect.yaml', console=Console(quiet=True))
    named = [page.label(each) for each in result['effects'] if 'expressions' not in each]
    laws = {'': {term: k['value'] for each in result['effects'] if 'expressions' in each
                 for term, k in each['parameters'].items()},
            '_baseline': sparse(paths[:2], base) if case.baseline else {}}
    answers = {which: with_formula(base, law) for which, law in laws.items()} | {
        '_all': RobotParameters.load(corrected) if result['effects'] else base}
    before = wrench(base, base, flown(base))
    true = wrench(plant, base, flown()) - before
    of_formula = result['formula']
    force = float(np.sqrt((true**2).sum(1).mean()))
    return {'truth': plant.effects, 'lost': lost, 'force_N': force, 'named': named,
            'verdict': result['verdict'], 'closure': result['closure'],
            'closure_of_formula': of_formula.get('closure'), 'reason': of_formula.get('reason'),
            'ln_bayes_factor': of_formula.get('ln_bayes_factor'),
            **{f'formula{which}': law for which, law in laws.items()},
            **{f'{kind}{which}': number for which, other in answers.items()
               for kind, number in agreement(
                   true, wrench(other, base, flown(other)) - before).items()}}


def line(case, row, kept=False):
    """A row of the table."""
    if 'failure' in row:
        return f'{case.name:42} {row["failure"]}'
    law = ' + '.join(f'{k:.3g} {term}' for term, k in row['formula'].items()) or row['reason']
    numbers = [row[key] for key in ('force_N', 'correlation', 'share_all', 'closure',
                                    'ln_bayes_factor')]
    if case.baseline:
        law += f" | baseline {row['correlation_baseline']:.3g}, " \
            f"{len(row['formula_baseline'])} terms"
    return f"{case.name:42} {row['controller']:4} " + ' '.join(
        '     -' if each is None else f'{each:6.3g}' for each in numbers) + (
        f" {', '.join(row['named']) or '-'} | {law}")


def summary(rows):
    """Counts of one kind of cases."""
    own = [row for row in rows if 'failure' not in row]
    laws = [row for row in own if row['formula']]
    return {'cases': len(rows), 'failures': len(rows) - len(own), 'formulas': len(laws),
            **{f'rediscovered{which}': sum(bool(
                row[f'correlation{which}'] >= LIKE and row['closure'] >= CLOSED) for row in laws)
                for which in ('', '_all')},
            'baseline_formulas': sum(bool(row['formula_baseline']) for row in own),
            'baseline_correlated': sum(row['correlation_baseline'] >= LIKE for row in own)}


def swept(function, cases, given, console, line):
    """Rows of cases by a function; those that this code has finished are kept and not repeated."""
    code = digest(*(path.read_bytes() for folder in (SOURCE, Path(__file__).parent)
                    for path in sorted(folder.rglob('*.py'))))
    return sweep(function, [(case._replace(key=digest(code, repr(case))),) for case in cases],
                 store=Store(given.out.with_suffix('')), jobs=given.jobs, console=console,
                 line=line)


def main():
    """Run the cases that are missing and print what all of them show."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', choices=KINDS, help='one kind of cases')
    parser.add_argument('--cases', type=int, help='of each kind (each effect, 50 undisturbed)')
    parser.add_argument('--jobs', type=int, help='at a time (every core)')
    parser.add_argument('--baseline', action='store_true', help='also plain sparse regression')
    parser.add_argument('--out', type=Path, default=Path('runs_out/formulas.json'),
                        help='results; finished cases are kept in a folder beside it')
    given = parser.parse_args()
    if given.baseline and importlib.util.find_spec('pysindy') is None:
        parser.error('--baseline: expected the package pysindy, which is no dependency')
    cases = [Case(f'{kind} {names[k % len(names)]} {k}', '', 1, kind, names[k % len(names)], k,
                  given.seed, given.baseline)
             for kind, names in KINDS.items() if given.only in (None, kind)
             for k in range(given.cases or (50 if kind == UNDISTURBED else len(names)))]
    console = Console(width=250)
    console.print(f'{"case":42} by    force [N], correlation of the formula, share of its power '
                  'with the entries named beside it, closure, ln B, these entries | formula')
    rows = swept(examined, cases, given, console, line)
    counts = {kind: summary(own) for kind in KINDS if (
        own := [row for row in rows if row['kind'] == kind])}
    write_json(given.out, {'seed': given.seed, 'summary': counts, 'cases': rows})
    console.print_json(data=counts)


if __name__ == '__main__':
    main()
