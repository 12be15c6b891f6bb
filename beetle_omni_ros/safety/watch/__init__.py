"""Detectors of faults in flight: pure functions of what was commanded and what was measured."""
