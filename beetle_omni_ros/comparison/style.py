"""Names, texts and line styles of controllers and conditions on the page."""

from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from beetle_omni_ros.control import registry


@dataclass(frozen=True)
class Look:
    """Label and text of a controller, and its line: colour, dashes, marker."""

    label: str
    text: str
    colour: str
    dashes: str | tuple = '-'
    marker: str = 'o'


PUBLISHED = 'published_'    # prefix of a controller in the publication
# Colours of controllers outside the package, chosen by name.
SPARE = ('#2a9d4b', '#7b4fb0', '#008c95', '#a0522d', '#6b7f1e')

CONDITIONS = {
    'nominal': 'simulator as measured: multibody plant, second-order servos, rotor lag, sensor '
               'noise, every delay, state estimation by the EKF',
    'published': "the same with the publication's randomisation, drawn from the seed: mass, "
                 'inertia, centre of mass, sensor biases, more noise, latencies',
}


def look(controller: str) -> Look:
    """Look of a controller, or of its published counterpart."""
    name = controller.removeprefix(PUBLISHED)
    entry = registry.SHIPPED.get(name)
    if entry is None:
        return Look(name, '', SPARE[crc32(name.encode()) % len(SPARE)], (0, (4, 1, 1, 1)), 'X')
    line = entry.line
    if name != controller:
        return Look(entry.label, 'the publication', line.colour, ':', '*')
    return Look(entry.label, entry.description, line.colour, line.dashes, line.marker)


def task_title(task: str) -> str:
    """Heading of a task."""
    titles = {'waypoints': 'Five waypoints', 'lemniscate': '3D lemniscate',
              'force': 'Force disturbance', 'torque': 'Torque disturbance',
              'payload': 'Payload', 'hover': 'Steady hover'}
    if task.startswith('random') and task[6:].isdigit():
        return f'{task[6:]} random poses'
    return titles.get(task, f'Poses of {Path(task).name}')
