"""
Faults of the simulated robot, its devices and the flight stack, switched at run time.

``Fault('rotor_weak', at=3.0, duration=1.0, rotor=2, share=0.5)`` is one; ``Simulator.set_faults``
takes a list, the in-process loop those of processes. KINDS names all kinds with their numbers.
"""

from beetle_omni_ros.sim.faults import actuators, processes, sensors, world  # noqa: F401
from beetle_omni_ros.sim.faults.base import Fault, KINDS
from beetle_omni_ros.sim.faults.schedule import Schedule

__all__ = ['Fault', 'KINDS', 'Schedule']
