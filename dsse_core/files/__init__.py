"""Files that users give, read within limits into strict tables: all problems at once, in the same words everywhere."""
