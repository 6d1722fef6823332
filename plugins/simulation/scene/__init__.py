"""The simulated scene behind the mock rig and the fake devices: skin, contact, plate, images."""
