"""What can be known before anything moves: orders, plans, checks of devices, file schemas."""
