"""Robots that a scene can hold."""
