"""One process per area: wire messages, keys, the protocol without I/O, strategies, transport and the loop.

Part of consensus-dsse.
"""
