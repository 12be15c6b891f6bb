"""Drivers of the servo bus and of the motor board, and the check before a flight."""
