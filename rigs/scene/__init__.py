"""The simulated scene behind the mock rig and the stand-ins: skin, contact, plate, pictures."""
