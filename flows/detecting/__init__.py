"""A trained network live on a rig's event stream."""
