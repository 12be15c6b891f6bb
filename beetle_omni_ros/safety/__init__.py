"""Arming, command selection, limits and fallback."""
