"""What a system on several hosts needs before it starts: area files, endpoints, keys."""
