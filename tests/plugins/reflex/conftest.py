"""The network and the protocol of the tests of live detection."""

from tests.flows.detect.conftest import model, protocol

__all__ = ["model", "protocol"]
