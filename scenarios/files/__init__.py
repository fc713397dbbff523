"""Files that users give and get: networks, readings, scenarios; strict TOML with all problems at once."""
