"""What a notebook adds to the Python interface: arrays, data sets, tables and figures."""
