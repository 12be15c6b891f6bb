"""Damaged recordings: what can be wrong with a bag, and who notices (see gap_damage.py)."""
