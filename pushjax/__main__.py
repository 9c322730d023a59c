"""Entry point of `python -m pushjax`."""

from pushjax.cli.main import main

main()
