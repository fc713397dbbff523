"""The tables of the thesis beside results of this program: V. Garaga, West Virginia University, chapter 5."""
