"""Guidance: functions around a controller that modify its pose targets."""
