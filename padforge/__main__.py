"""`python -m padforge`: the command line."""

from padforge.cli import main

main()
