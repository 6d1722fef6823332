"""Conformance suite for drivers of packages outside of SlipLab; see `sliplab.rigs.testing`.

from sliplab.testing import conformance
test_driver = conformance(DRIVER, MySettings(host="127.0.0.30"))
"""

from sliplab.rigs.testing.conformance import Case, cases, conformance, free_port
from sliplab.rigs.testing.rule import Bounds, NotTried, RuleBroken

__all__ = ["Bounds", "Case", "NotTried", "RuleBroken", "cases", "conformance", "free_port"]
