"""The grid: network, meters and their model h(x), H(x), areas and how a network is divided."""
