"""Capture sessions: from a file that says what to capture to a dataset that nothing is lost from."""
