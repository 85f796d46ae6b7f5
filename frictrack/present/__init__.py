"""What people see of results: figures, the report, files of other programs."""
