"""Conformance suite for drivers of packages outside of SlipLab; see `sliplab.plugins.driver_kit`.

from sliplab.testing import conformance
test_driver = conformance(DRIVER, MySettings(host="127.0.0.30"))
"""

from sliplab.plugins.driver_kit.conformance import Case, cases, conformance, free_port
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, RuleBroken

__all__ = ["Bounds", "Case", "NotTried", "RuleBroken", "cases", "conformance", "free_port"]
