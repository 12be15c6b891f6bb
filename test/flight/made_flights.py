"""Results of a sweep with artificial motions instead of flights."""

from itertools import product
import json

from synthetic_flights import fly

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.compare import ComparedFlight, trace

TASKS = ('random3', 'waypoints', 'lemniscate', 'force', 'torque', 'wind', 'pushes',
         'payload', 'hover')
FAILED = {'failure': 'no take-off <within> 30 s', 'metrics': None, 'trace': {}, 'cpu_s': 1.0,
          'host': 'here'}


def made(task, duration=None):
    """Result of one made-up flight of a task, cut off after ``duration`` [s]."""
    flown = make_task(task)
    recorder = LogRecorder({'task': task, 'seed': 0})
    fly(recorder, flown, controller='nmpc', duration=duration, tick=0.02)
    log = recorder.log()
    judged = metrics(log, flown)
    return {'failure': None, 'metrics': json.loads(json.dumps(judged)), 'trace': trace(log, flown),
            'cpu_s': 12.5, 'host': 'here'}


def scaled(value, factor, key=''):
    """Return the same metrics with every measured float multiplied, so that no two are equal."""
    if isinstance(value, dict):
        return {name: scaled(entry, factor, name) for name, entry in value.items()}
    if isinstance(value, list) and key != 'target':
        return [scaled(entry, factor) for entry in value]
    fixed = key == 'target' or key.startswith(('level', 'lost', 'withstood', 'payload'))
    return value * factor if isinstance(value, float) and not fixed else value


def made_sweep(controllers):
    """Results of a whole comparison, all numbers different."""
    flown, factor = {}, 1.0
    for task in TASKS:
        result = made(task)
        for condition, controller, seed in product(('nominal', 'published'), controllers, (0, 4)):
            factor += 0.013
            flown[ComparedFlight(task, condition, controller, seed)] = {
                **result, 'metrics': scaled(result['metrics'], factor)}
    return flown
