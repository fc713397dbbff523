"""The command line ``dsse``: a few lines for each command, which call the other rooms and print."""
