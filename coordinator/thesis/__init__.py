"""The tables of the thesis beside ours: V. Garaga, West Virginia University, chapter 5."""
