"""ATI Net F/T force/torque sensors: Raw Data Transfer (RDT) over UDP, and their web page."""
