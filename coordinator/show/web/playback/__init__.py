"""Playback of a run on the page: its states, messages and events at any moment."""
