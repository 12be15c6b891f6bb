"""How controllers and conditions are called and drawn, everywhere on the page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beetle_omni_ros.runs.figures import FAINT, INK


@dataclass(frozen=True)
class Look:
    """A controller's name, what it is, and its line: colour, dashes, marker."""

    label: str
    text: str
    colour: str
    dashes: str | tuple = '-'
    marker: str = 'o'


# Blue for RL and red for NMPC as in the publication; the variants are lighter and dashed, so that
# all four differ in brightness and in line, too, for those who cannot tell the colours.
LOOKS = {
    'rl': Look('RL', 'the learned policy, 33 observations', '#1b5fb4', '-', 'o'),
    'rl_memory': Look('RL, memory', 'the learned policy that also sees the estimated disturbance',
                      '#58b4e8', (0, (5, 1.6)), 's'),
    'nmpc': Look('NMPC', 'offset-free, params/nmpc.yaml', '#c8281e', '-', '^'),
    'nmpc_published': Look('NMPC, published settings', 'params/nmpc_published.yaml', '#e8960c',
                           (0, (3, 1.2, 1, 1.2)), 'v'),
    'hover': Look('hover PD', "PD with allocation, the supervisor's fallback", '#5b6770',
                  (0, (1, 1.2)), 'D'),
    'published_rl': Look('RL', 'the publication', '#1b5fb4', ':', '*'),
    'published_nmpc': Look('NMPC', 'the publication', '#c8281e', ':', '*'),
}

CONDITIONS = {
    'nominal': 'simulator as measured: multibody plant, second-order servos, rotor lag, sensor '
               'noise, every delay, state estimation by the EKF',
    'published': "the same with the publication's randomisation, drawn from the seed: mass, "
                 'inertia, centre of mass, sensor biases, more noise, latencies',
}

__all__ = ['CONDITIONS', 'FAINT', 'INK', 'Look', 'look', 'LOOKS']


def look(controller: str) -> Look:
    """Look of a controller; a grey one for a name without."""
    return LOOKS.get(controller, Look(controller, '', FAINT))


def task_title(task: str) -> str:
    """What a task is called in headings."""
    titles = {'waypoints': 'Five waypoints', 'lemniscate': '3D lemniscate',
              'force': 'Force disturbance', 'torque': 'Torque disturbance',
              'payload': 'Payload', 'hover': 'Steady hover'}
    if task.startswith('random') and task[6:].isdigit():
        return f'{task[6:]} random poses'
    return titles.get(task, f'Poses of {Path(task).name}')
