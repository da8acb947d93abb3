"""What a registration found, in files that other tools read."""
