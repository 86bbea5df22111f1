"""What everything stands on: errors, files, units, settings, the cache."""
