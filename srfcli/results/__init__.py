"""What tasks find: one frozen value each, which owns its columns, rows, notes and figure."""
