"""The command-line interface and the HTML page of its results."""
