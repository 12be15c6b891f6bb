"""
Faults of the simulated robot, its devices and the flight stack.

An example is ``Fault('rotor_weak', at=3.0, duration=1.0, rotor=2, share=0.5)``. Faults of robot
and devices go to ``Simulator.set_faults``, those of processes to the in-process loop. KINDS
contains all kinds.
"""

from beetle_omni_ros.sim.faults import actuators, processes, sensors, world  # noqa: F401
from beetle_omni_ros.sim.faults.base import Fault, KINDS
from beetle_omni_ros.sim.faults.schedule import Schedule

__all__ = ['Fault', 'KINDS', 'Schedule']
