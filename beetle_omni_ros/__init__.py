"""Flight stack and controller comparison for an overactuated tiltable quadrotor."""

__version__ = '0.1.0'
