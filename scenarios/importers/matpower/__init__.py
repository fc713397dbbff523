"""Networks of MATPOWER: case files, version 2."""
