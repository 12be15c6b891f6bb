"""The flight stack as components, the loop that runs them, and campaigns of flights."""
