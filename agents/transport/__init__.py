"""Zenoh: sessions, publishers, subscribers, presence. The only package that imports it."""
