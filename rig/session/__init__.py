"""Capture sessions: from a file that says what to capture to a dataset, losing nothing."""
