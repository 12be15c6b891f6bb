"""What a flight leaves: topics, their messages, the log, its bag and its numbers."""
