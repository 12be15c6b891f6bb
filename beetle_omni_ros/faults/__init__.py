"""Flights with faults: what happens, how often it ends as it should, and one page about it."""
