"""Flights of any laboratory: tables with declared formats, residuals, evidence, verdict."""
