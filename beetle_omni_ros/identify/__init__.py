"""Actuator models from measured data: servo response logs and rotor bench logs."""
