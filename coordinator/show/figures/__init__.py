"""Figures of runs and studies, diagrams of networks, and the style and files of both."""
