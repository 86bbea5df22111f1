"""The `srf` command: modules that are light to import, each with the commands of one subject."""
