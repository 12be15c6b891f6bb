"""Emulated servo bus and motor board on pseudo-terminals, and their coupling to a simulator."""
