"""The standard streams in the place of files."""

STREAM = "-"
"""What stands for standard input or standard output where a path is expected."""
