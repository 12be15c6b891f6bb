"""
Fly a robot of your own from a file with its differences: a heavier robot with slower rotors.

    python examples/own_robot.py [TASK]

In the first flight, estimator and controller use the shipped robot; in the second, the true one.
"""

from pathlib import Path
import sys
import tempfile

import beetle_omni_ros
from beetle_omni_ros.model.resources import share_path

ROBOT = """\
extends: {base}
mass: 3.4                       # [kg]
rotors: {{time_constant: 0.18}}   # [s]
effects:
  thrust_coefficient: {{scale: 0.95}}
"""


if __name__ == '__main__':
    task = sys.argv[1] if len(sys.argv) > 1 else 'waypoints'
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'my_robot.yaml'
        file.write_text(ROBOT.format(base=share_path('params/robot.yaml')))
        mine = beetle_omni_ros.robot(file)
        print(f'{mine.mass:g} kg, hover with {mine.hover_thrust:.2f} N a rotor')
        for believed in (None, file):
            results = beetle_omni_ros.evaluate('nmpc', task, robot=believed, plant=file,
                                               quiet=True)
            mean = results['nmpc']['mean']
            print(f"{'known' if believed else 'unknown'} robot: on the way "
                  f"{mean['L_position_m']:.3f} m, {mean['L_orientation_deg']:.2f} deg")
