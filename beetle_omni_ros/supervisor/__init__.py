"""State machine of a flight: arming, detectors, degraded flight, landing."""
