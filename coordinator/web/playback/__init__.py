"""A run that is over, played on the page: what has happened in it, at any moment of it."""
