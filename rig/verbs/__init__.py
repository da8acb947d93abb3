"""The verbs of the command line that belong to the rig: one module each."""
