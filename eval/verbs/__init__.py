"""The verbs of the command line that eval brings."""
