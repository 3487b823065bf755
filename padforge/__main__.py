"""`python -m padforge`: the command line."""

from . import main

main()
