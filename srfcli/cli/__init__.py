"""The `srf` command: one short module per subcommand, light to import."""
