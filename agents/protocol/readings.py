"""The readings of an area's meters in its current scan, and the net load that follows from them."""

from __future__ import annotations

from collections.abc import Iterator

from agents.area_files.area_file import AreaFile
from agents.messages.packing import TelemetryMessage
from agents.peers.rejections import find_reading_rejection
from dsse_core.exchange.boundary_load import NetLoad, measured_net_loads, own_net_load
from dsse_core.grid.measurement import Measurement, Source


class Readings:
    """``measurements``: those of the scan, virtual ones included. ``silent``: ids of the meters without a reading.

    ``invalid``: of those whose reading its source has marked as not valid.
    """

    def __init__(self, content: AreaFile) -> None:
        self._content = content
        self._meters = {meter.id: meter for meter in content.meters}
        self._virtual = {
            meter_id: Measurement(m, 0.0, 0.0) for meter_id, m in self._meters.items() if m.source is Source.VIRTUAL
        }
        self.measurements: tuple[Measurement, ...] = tuple(self._virtual.values())
        self.silent = [meter_id for meter_id in self._meters if meter_id not in self._virtual]
        self.invalid: list[str] = []
        self._net_load: NetLoad | None = None  # of these measurements, once asked for

    def take(self, message: TelemetryMessage) -> Iterator[str]:
        """Take over a scan; for each reading that is rejected, the reason."""
        readings: dict[str, Measurement] = {}
        self.invalid = []
        columns = message.meters, message.values, message.sigmas, message.valid
        for meter_id, value, sigma, is_valid in zip(*columns, strict=True):
            meter = self._meters.get(meter_id)
            if meter is None or meter.source is Source.VIRTUAL:
                yield "unknown meter"
            elif not is_valid:
                self.invalid.append(meter_id)
                yield "marked invalid"
            elif reason := find_reading_rejection(value, sigma):
                yield reason
            else:
                readings[meter_id] = Measurement(meter, value, sigma)
        read = readings | self._virtual
        self.measurements = tuple(read.values())
        self.silent = [meter_id for meter_id in self._meters if meter_id not in read and meter_id not in self.invalid]
        self._net_load = None

    @property
    def net_load(self) -> NetLoad:
        """Of the area's own buses, generation as the area file says: by these readings or as scheduled."""
        if self._net_load is None:
            telemetered = self._content.generation == "telemetered"
            measured = measured_net_loads(self._content.area, self.measurements) if telemetered else {}
            self._net_load = own_net_load(self._content.area, measured)
        return self._net_load
