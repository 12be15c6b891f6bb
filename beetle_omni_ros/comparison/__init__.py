"""Every published experiment for several controllers: one sweep of flights, one page."""
