"""Simulated gantries: axes that move as real ones do, behind the controllers' own protocols."""
