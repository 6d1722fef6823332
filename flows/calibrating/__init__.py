"""Teaching and calibrating a rig: what is measured is asked for, checked, and written down."""
