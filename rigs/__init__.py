"""What does it: rig files, device capabilities, drivers, and the simulated rig."""
