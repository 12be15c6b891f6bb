"""A recording checked against itself: clocks, values, units and conventions."""
