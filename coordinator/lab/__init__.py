"""Experiments: runs on processes and on the simulator, their evaluation, studies, and the cases of the thesis."""
