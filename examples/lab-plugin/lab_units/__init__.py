"""Units of this lab: symbol, dimension, and size in the canonical unit of the dimension."""

UNITS = {
    "mil": ("length", "0.0254"),
    "kPa": ("pressure", "1"),  # a new dimension: its unit of size 1 is canonical
    "bar": ("pressure", "100"),
}
