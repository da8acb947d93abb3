"""The verbs of the command line that belong to the simulator: one module each."""
