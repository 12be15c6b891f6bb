"""Emulated devices on pseudo-terminals, to the byte; written without the drivers they judge."""
