"""`python -m sliplab`: the command line."""

from sliplab.flows.__main__ import main

main()
