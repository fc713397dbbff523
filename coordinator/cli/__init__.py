"""The command line ``dsse``: a few lines for each command, which call the other packages and print."""
