"""Emulated devices on pseudo-terminals; they speak the real protocols byte by byte."""
