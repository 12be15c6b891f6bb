"""Flights of bags and tables, read and checked against themselves: clocks, values, conventions."""
