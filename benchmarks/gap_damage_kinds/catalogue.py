"""Every kind of damage, by name."""

from gap_damage_kinds import clocks, imu, mocap
from gap_damage_kinds.kind import KINDS

FAMILIES = (mocap, imu, clocks)

__all__ = ['FAMILIES', 'KINDS']
