"""Preparation of a system on several hosts: area files, endpoints, keys."""
