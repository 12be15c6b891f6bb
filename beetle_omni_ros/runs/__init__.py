"""Recorded flights: bags, tasks, metrics, plots and reports."""
