"""Pictures of finished runs, for reports: one module a kind, each drawn from the plain files."""
