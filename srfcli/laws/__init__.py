"""Laws as values and as files, their registry, and what the author of one imports."""
