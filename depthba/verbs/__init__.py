"""The verbs of the command line that belong to the library: one module each."""

DONE, KNOWN_ERROR, WRONG_USAGE, NOT_TO_BE_TRUSTED, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit statuses of every verb."""
