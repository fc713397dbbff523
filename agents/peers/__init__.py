"""What an area knows of its neighbours: what they sent last, how new it is, whether both agree; what is rejected."""
