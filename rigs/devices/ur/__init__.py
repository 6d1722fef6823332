"""Universal Robots arms: RTDE, dashboard, script port, and ur_rtde in a process of its own."""
