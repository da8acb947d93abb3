"""Formats of other people, one module each; `FORMAT` in it says what it can do."""
