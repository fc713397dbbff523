"""Processor time and memory of every command against the size of the grid."""
