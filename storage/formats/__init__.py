"""Files of others, read as data and never trusted; and ours, written as others read them."""
