"""Detectors of faults in flight: pure functions of commands and measurements."""
