"""Judges runs: metrics, reports, recordings and their review."""
