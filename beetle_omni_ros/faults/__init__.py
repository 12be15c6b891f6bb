"""Flights with faults: their outcomes, compared with the expected ones, and one page."""
