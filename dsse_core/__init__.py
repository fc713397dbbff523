"""The mathematics: networks, power flow, measurements, estimation, bad data, areas. No clocks or bus.

Part of consensus-dsse.
"""
