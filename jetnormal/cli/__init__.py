"""The `jetnormal` command: one small module per subcommand."""
