"""Emulated devices on pseudo-terminals, independent of the drivers that they test."""
