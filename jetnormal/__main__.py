"""`python -m jetnormal`."""

from jetnormal.cli.app import program

program()
