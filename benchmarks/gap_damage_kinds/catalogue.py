"""Every kind of damage, by name."""

from gap_damage_kinds import clocks, commands, imu, joints, mocap, transport
from gap_damage_kinds.kind import KINDS

FAMILIES = (mocap, imu, joints, commands, clocks, transport)

__all__ = ['FAMILIES', 'KINDS']
