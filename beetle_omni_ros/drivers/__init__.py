"""Bytes to hardware: the servo bus and the motor board."""
