"""What everything stands on: errors, files, units, settings, the cache; and the version of the package."""

__version__ = "0.1.0"
