"""Zenoh: sessions, publishers, subscribers, presence. The only room that imports it."""
