"""Thrust, torque and lag of one rotor from logs of a force-torque stand."""
