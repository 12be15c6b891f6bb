"""Controllers: functions of state and target."""
