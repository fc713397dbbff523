"""Meters of the small feeder, made up: every half second a line of JSON with the readings of all of them.

``python meters.py [SECONDS [PORT]]``: for so long (0: for ever), on standard output or as UDP packets to PORT.
"""

import contextlib
import json
import random
import socket
import sys
import time

READINGS = {
    "works/u": 11020.0,  # V
    "works/in/p": 2011.0,  # kW
    "works/in/q": 817.0,  # kvar
    "works/p": 1200.0,  # kW, taken
    "works/q": 500.0,
    "village/in/p": 802.0,
    "village/in/q": 303.0,
    "village/p": 800.0,
    "village/q": 300.0,
}


def main(duration_s: float = 0.0, port: int = 0) -> None:
    """Send the readings of the meters, each with an error of some tenths of a percent."""
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end = time.time() + duration_s if duration_s else float("inf")
    while time.time() < end:
        values = {address: value * random.gauss(1.0, 0.003) for address, value in READINGS.items()}
        if port:
            for address, value in values.items():
                sender.sendto(f"{address} {value:.3f}".encode(), ("127.0.0.1", port))
        else:
            print(json.dumps({"time": time.time(), "values": values}), flush=True)
        time.sleep(0.5)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        main(*map(float, sys.argv[1:2]), *map(int, sys.argv[2:3]))
