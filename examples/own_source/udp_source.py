"""Source ``udp``: packets of text, ``ADDRESS VALUE``."""

import asyncio

from coordinator.field.gateway import Emit, Source, Table


class UdpSettings(Table):
    """The keys of ``[source]`` beside ``kind``."""

    port: int
    host: str = "127.0.0.1"


class UdpSource(Source):
    """Source of UDP packets of two words, an address and a value."""

    Settings = UdpSettings

    async def read(self, emit: Emit) -> None:
        class Receiver(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, sender: tuple[str, int]) -> None:
                match data.decode(errors="replace").split():
                    case [address, value]:
                        emit(address, number_in(value))
                    case _:
                        emit.reject("malformed", f"packet {data[:80]!r} of {sender[0]}")

        loop = asyncio.get_running_loop()
        place = (self.settings.host, self.settings.port)
        transport, _ = await loop.create_datagram_endpoint(Receiver, local_addr=place)
        try:
            await asyncio.Event().wait()  # for ever
        finally:
            transport.close()


def number_in(text: str) -> float | str:
    """The number in ``text``; else the text, which is counted as no number."""
    try:
        return float(text)
    except ValueError:
        return text
