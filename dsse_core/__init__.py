"""The mathematics: networks, power flow, measurements, estimation, bad data, areas. No files, clocks or bus."""
