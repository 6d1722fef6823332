"""Stand-ins that speak the devices' own protocols, so that drivers are tested without devices."""
