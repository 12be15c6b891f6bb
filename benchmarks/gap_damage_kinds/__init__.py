"""Kinds of damage of a bag, and whether the gap finder detects them (see gap_damage.py)."""
