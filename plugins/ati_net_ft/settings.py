"""Settings of an ATI Net F/T sensor, as a rig file gives them; cheap to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.yaml_file import rule
from sliplab.rigs.core.device_settings import DriverSettings

Angle = Annotated[float, Field(ge=-360, le=360)]
Filter = Literal[0, 5, 8, 18, 35, 73, 152, 326, 838]
FILTER_NUMBERS: dict[int, int] = {
    0: 0,
    838: 1,
    326: 2,
    152: 3,
    73: 4,
    35: 5,
    18: 6,
    8: 7,
    5: 8,
}
"""Numbers by which the sensor's web page names its low-pass filters, by their cut-off in Hz."""


class AtiNetFtSettings(DriverSettings):
    """An ATI Net F/T sensor (Net Box), or an Ethernet Axia, which speaks the same protocol."""

    driver: Literal["ati_net_ft"] = "ati_net_ft"
    host: str = Field(min_length=1)
    """Name or address of the sensor; it leaves the factory with 192.168.1.1."""
    port: int = Field(default=49152, ge=1, le=65535)
    """UDP port of its raw data transfer (RDT)."""
    web_port: int = Field(default=80, ge=1, le=65535)
    """TCP port of its web page, which holds its calibration."""
    rate_hz: int | None = Field(default=None, ge=1, le=7812)
    """Records a second, written to the sensor when it is connected; null leaves them as they are
    set. A Net Box takes whole fractions of 7000."""
    tick_hz: int = Field(default=7000, ge=100, le=100_000)
    """Steps of the sensor's own sample counter a second, its clock: 7000 of a Net Box; of an Axia
    the ADC rate on its page of settings."""
    counts_per_n: float | None = Field(default=None, gt=0, le=1e12)
    """Counts of a newton; null reads them, and the units, from the sensor's page."""
    counts_per_nm: float | None = Field(default=None, gt=0, le=1e12)
    """Counts of a newton metre; given together with `counts_per_n`."""
    filter_hz: Filter | None = None
    """Cut-off of the sensor's own low-pass filter, written when it is connected; 0 is no filter;
    null leaves it as it is set. A filter delays what it reports: see `timing.force.delay`."""
    bias: Literal["trial", "session", "never"] = "trial"
    """When the present load becomes zero: before every trial while the sensor is clear of the
    plate, once when it is connected, or never."""
    mounted: Literal["plate", "arm"] = "plate"
    """Behind the plate, or between the arm's flange and the tactile sensor."""
    mounting_rotvec_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Rotation vector from the sensor's axes to the plate's (x right, y up, z into the plate)."""
    answer_s: float = Field(default=0.5, gt=0, le=10)
    """Time limit of each request, which is sent three times; the page is asked once."""
    silence_s: float = Field(default=0.5, gt=0, le=60)
    """A stream of which nothing comes for so long has failed."""

    @rule
    def _calibration(self) -> AtiNetFtSettings:
        given = [self.counts_per_n is not None, self.counts_per_nm is not None]
        if any(given) and not all(given):
            missing = "counts_per_nm" if given[0] else "counts_per_n"
            raise KeyedError(f".{missing}", None, "must be given where the other one is")
        return self

    @property
    def reads_page(self) -> bool:
        """True if the sensor's web page is needed."""
        return self.counts_per_n is None or self.rate_hz is not None or self.filter_hz is not None
