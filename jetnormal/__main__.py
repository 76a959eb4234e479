"""`python -m jetnormal`."""

from jetnormal.cli.app import main

main()
